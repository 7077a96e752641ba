"""First messages: what a reliable publisher sends once it has matched reaches the readers that wait elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.intervals import READER
from proxy.endpoints.core.qos import default
from tests.draws import draws
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites

CHATTER = f"name: /chatter, type: {STRING}"
OTHER = "nuc3/other"
LATCHED = default(latched=True, depth=10)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def is_matched(machine: Machine) -> bool:
    """Return whether the proxy of a machine reads the local topic, which is all that a local publisher sees."""
    return bool(machine.graph.subscriptions("/chatter", STRING))


@draws(3)
@given(
    count=st.integers(1, 60),
    stays_s=st.floats(0.0, 2.0),
    every_s=st.floats(0.001, 0.05),
    is_latched=st.booleans(),
    seed=st.integers(0, 1 << 16),
    loss=st.sampled_from([0.0, 0.05]),
)
def test_waiting_readers_get_all_that_a_node_says_before_it_leaves(
    tmp_path_factory: pytest.TempPathFactory,
    count: int,
    stays_s: float,
    every_s: float,
    is_latched: bool,
    seed: int,
    loss: float,
) -> None:
    sites = Sites(tmp_path_factory.mktemp("sites"), seed=seed)
    for sim_link in sites.world.cables.values():
        sim_link.loss = loss
    qos = default(latched=True, depth=64) if is_latched else default()
    robot = sites.add(ROBOT, expose=[CHATTER])
    ears = [Ear(sites.add(label, imports=[CHATTER]).graph, "/chatter", qos=qos) for label in (SERVER, OTHER)]
    sites.run(5)
    talker = robot.graph.publish("/talker", "/chatter", STRING, qos=qos)
    assert sites.run(1, lambda: is_matched(robot))
    sites.every(every_s, count, lambda number: talker.publish(string(str(number))))
    sites.run(count * every_s + stays_s)
    talker.close()
    said = [str(number) for number in range(count)]
    assert sites.run(READER.lease_s + 4, lambda: all(ear.texts == said for ear in ears)), [len(e.texts) for e in ears]
    sites.run(2)
    assert [ear.texts for ear in ears] == [said, said]


def test_a_reader_that_comes_later_gets_nothing_from_before(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(1, lambda: is_matched(robot))
    talker.publish(string("stand up"))
    sites.run(1)
    ear = Ear(server.graph, "/chatter")
    assert sites.run(3, robot.is_read)
    talker.publish(string("sit down"))
    assert sites.run(1, lambda: ear.texts == ["sit down"])
    sites.run(READER.lease_s)
    assert ear.texts == ["sit down"]


def test_a_later_reader_gets_nothing_that_another_waited_for(sites: Sites) -> None:
    robot, server, other = (
        sites.add(ROBOT, expose=[CHATTER]),
        sites.add(SERVER, imports=[CHATTER]),
        sites.add(OTHER, imports=[CHATTER]),
    )
    waiting = Ear(server.graph, "/chatter")
    sites.run(3)
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(1, lambda: is_matched(robot))
    talker.publish(string("stand up"))
    sites.run(0.5)
    late = Ear(other.graph, "/chatter")
    assert sites.run(3, lambda: robot.is_read(2))
    talker.publish(string("sit down"))
    sites.run(1)
    assert late.texts == ["sit down"]
    assert waiting.texts == ["stand up", "sit down"]


def test_what_no_reader_waits_for_is_kept_for_a_moment_and_counted(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER])
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    sites.run(2)
    for number in range(100):
        talker.publish(string(str(number)))
    sites.run(1)
    assert len(robot.stream.queue.deferred.waiting) == 64
    sites.run(READER.lease_s)
    assert len(robot.stream.queue.deferred.waiting) == 0
    assert robot.stream.losses.total == 100
    talker.publish(string("?"))
    sites.run(1)
    assert robot.context.traffic.unread == 1
    assert robot.stream.losses.total == 101


@draws(1)
@given(
    count=st.integers(1, 60),
    every_s=st.floats(0.01, 0.5),
    cut_s=st.floats(0.5, 25.0),
    is_known=st.booleans(),
    seed=st.integers(0, 1 << 16),
)
@example(count=20, every_s=0.1, cut_s=20.0, is_known=True, seed=0)
@example(count=60, every_s=0.3, cut_s=12.0, is_known=False, seed=1)
def test_what_a_waiting_reader_did_not_get_is_counted(
    tmp_path_factory: pytest.TempPathFactory, count: int, every_s: float, cut_s: float, is_known: bool, seed: int
) -> None:
    sites = Sites(tmp_path_factory.mktemp("sites"), seed=seed)
    robot = sites.add(ROBOT, expose=[CHATTER])
    servers = [sites.add(label, imports=[CHATTER]) for label in (SERVER, OTHER)]
    ears = [Ear(server.graph, "/chatter") for server in servers]
    sites.run(5 if is_known else 0.1)
    cut = [cable for ends, cable in sites.world.cables.items() if SERVER.partition("/")[0] in str(ends)]
    assert cut
    for cable in cut:
        cable.loss = 1.0
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(1, lambda: is_matched(robot))
    sites.every(every_s, count, lambda number: talker.publish(string(str(number))))
    sites.run(cut_s)
    for cable in cut:
        cable.loss = 0.0
    sites.run(count * every_s + 30)
    said = [str(number) for number in range(count)]
    for server, ear in zip(servers, ears, strict=True):
        (stats,) = (each for each in server.bridge.stats if each.topic == "/chatter")
        assert ear.texts == said[count - len(ear.texts) :]
        assert stats.lost == count - len(ear.texts)
