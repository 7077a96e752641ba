"""Thousands of appearances and disappearances, after which a proxy is unchanged."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.draws import IS_LONG
from tests.insiders.oracle import forget_decoded
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites

CHATTER = f"name: /chatter, type: {STRING}"
SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
TIMES = 10_000 if IS_LONG else 300
WARM = 300  # repetitions, until all is in use
SPARE = 100  # objects, of some hundred thousand


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def objects() -> int:
    forget_decoded()
    gc.collect()
    return len(gc.get_objects())


def look(sites: Sites, machine: Machine) -> None:
    """Let the proxy poll its present graph, without waiting for the overlay."""
    now_s = sites.now_s
    machine.bridge.work(now_s)
    machine.member.flush(now_s)
    sites.world.network.send_pending(machine.label)


def assert_it_stays(sites: Sites, machine: Machine, once: Callable[[], None], warm: int = WARM) -> None:
    """Repeat an action some thousand times, and compare the state after with the state before."""

    def repeat(times: int) -> None:
        for number in range(times):
            once()
            if number % 100 == 0:
                sites.run(0.05)

    repeat(warm)
    sites.run(60)
    before = objects(), descriptors(), machine.endpoint.handles, len(machine.bridge.flows)
    repeat(TIMES)
    sites.run(60)
    after = objects(), descriptors(), machine.endpoint.handles, len(machine.bridge.flows)
    assert after[1:] == before[1:]
    assert after[0] - before[0] < SPARE


def test_publishers_that_come_and_go(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    ear = Ear(server.graph, "/chatter")

    def once() -> None:
        publication = robot.graph.publish("/talker", "/chatter", STRING)
        look(sites, robot)
        publication.close()
        look(sites, robot)

    assert_it_stays(sites, robot, once)
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("still here"))
    assert sites.run(1, lambda: ear.texts == ["still here"])


def test_readers_that_come_and_go(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    talker = robot.graph.publish("/talker", "/chatter", STRING)

    def once() -> None:
        ear = Ear(server.graph, "/chatter")
        look(sites, server)
        ear.leave()
        look(sites, server)

    assert_it_stays(sites, server, once)
    ear = Ear(server.graph, "/chatter")
    assert sites.run(3, robot.is_read)
    talker.publish(string("still here"))
    assert sites.run(1, lambda: ear.texts == ["still here"])


@pytest.mark.nightly
def test_servers_that_come_and_go(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])

    def once() -> None:
        local = LocalServer(server.graph)
        look(sites, server)
        local.handle.close()
        look(sites, server)

    assert_it_stays(sites, server, once)
    LocalServer(server.graph, answer=lambda _: switched("still here"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("still here")])


@pytest.mark.nightly
def test_topics_of_ever_new_names_under_a_pattern(sites: Sites, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR, "proxy.bridge.faults")  # otherwise it would keep them all
    robot = sites.add(ROBOT, expose=["name: /many/*"], holds=[])
    count = iter(range(1_000_000))

    def once() -> None:
        publication = robot.graph.publish("/talker", f"/many/t{next(count)}", STRING)
        look(sites, robot)
        publication.close()
        look(sites, robot)

    assert_it_stays(sites, robot, once, 5_000)
