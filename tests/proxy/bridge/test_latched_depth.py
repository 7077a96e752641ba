"""Depth of latched topics: a late reader far away gets what a late reader near the publisher gets."""

from __future__ import annotations

from pathlib import Path

import pytest

from proxy.endpoints.core.qos import DEPTH_MAX, default
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import Publication

MAP = f"name: /map, type: {STRING}"
READER = default(latched=True, depth=1_000)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def node(robot: Machine, depth: int) -> Publication:
    qos = default(latched=True, depth=depth)
    return robot.graph.publish("/node", "/map", STRING, qos, hides_depth=True)


def late(machine: Machine) -> Ear:
    return Ear(machine.graph, "/map", qos=READER)


@pytest.mark.parametrize(("depth", "count"), [(1, 5), (3, 3), (3, 4), (10, 5), (10, 15), (100, 80)])
def test_near_and_far_late_readers_get_the_same(sites: Sites, depth: int, count: int) -> None:
    robot, server = sites.add(ROBOT, expose=[MAP]), sites.add(SERVER, imports=[MAP])
    talker = node(robot, depth)
    sites.run(1)
    sites.every(0.01, count, lambda number: talker.publish(string(str(number))))
    sites.run(6)
    near, far = late(robot), late(server)
    assert sites.run(5, lambda: bool(far.texts))
    sites.run(1)
    assert far.texts == near.texts[-DEPTH_MAX:]
    assert robot.faults == {}


def test_what_was_published_before_the_proxy_came_is_kept_whole(sites: Sites) -> None:
    robot, server = sites.add(ROBOT), sites.add(SERVER, imports=[MAP])
    talker = node(robot, 10)
    for number in range(5):
        talker.publish(string(str(number)))
    sites.reload(robot, expose=[MAP])
    sites.run(5)
    far = late(server)
    assert sites.run(5, lambda: far.texts == ["0", "1", "2", "3", "4"])


def test_a_depth_that_is_found_holds_for_its_publisher_only(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[MAP]), sites.add(SERVER, imports=[MAP])
    talker = node(robot, 1)
    sites.run(1)
    sites.every(0.01, 5, lambda number: talker.publish(string(str(number))))
    sites.run(5)
    assert robot.stream.queue.depth == 1
    talker.close()
    other = node(robot, 10)
    sites.run(1)
    for number in range(4):
        other.publish(string(f"other {number}"))
    sites.run(5)
    far = late(server)
    assert sites.run(5, lambda: len(far.texts) >= 4)
    assert far.texts[-4:] == [f"other {number}" for number in range(4)]


def test_a_publisher_that_is_never_quiet_is_not_probed(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[MAP])
    talker = node(robot, 3)
    sites.run(1)
    sites.every(0.1, 100, lambda number: talker.publish(string(str(number))))
    sites.run(9)
    assert len(robot.graph.subscriptions("/map", STRING)) == 1
    assert robot.stream.queue.depth == DEPTH_MAX


def test_a_rule_says_how_much_is_kept(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[f"{MAP}, history: 2"]), sites.add(SERVER, imports=[MAP])
    talker = node(robot, 10)
    sites.run(1)
    sites.every(0.01, 5, lambda number: talker.publish(string(str(number))))
    sites.run(5)
    far = late(server)
    assert sites.run(5, lambda: far.texts == ["3", "4"])
