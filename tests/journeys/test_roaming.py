"""Moving robot: it attaches at another switch and is found there, in every tier."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.crypto.statements import parse
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.rib.route import Route
from gdp.trust.advertisement import UnverifiedAdvertisement
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Flow, Tap, flowing, ring
from tests.lanes import nightly


def place_in(world: Simulation, rib: str, name: Name, node: Name) -> str:
    """Return the switch of a node according to a RIB."""
    route = world.ribs[rib].rib.state.store.get(name, node)
    assert isinstance(route, Route)
    switch = parse(UnverifiedAdvertisement.from_statement(parse(route.advertisement)).rtcert).fields["switch"]
    return next(label for label, each in world.switches.items() if each.name == switch)


@pytest.mark.parametrize("to", ["nuc5", *nightly("nuc2", "nuc3", "nuc4")])
def test_a_publisher_that_moves_keeps_its_readers_and_loses_nothing(to: str) -> None:
    flow = flowing(ring())
    flow.stream(200, 0.02, size=100)
    flow.world.network.call(1.0, lambda: flow.world.roam(ROBOT, to))
    assert flow.world.network.run(20, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    flow.outlive()


@pytest.mark.parametrize("to", ["nuc3", *nightly("nuc2", "nuc5")])
def test_a_publisher_that_moved_is_known_there_in_every_tier(to: str) -> None:
    flow = flowing(ring())
    world = flow.world
    world.roam(ROBOT, to)
    world.network.run(2)
    node = world.members[ROBOT].name
    for rib in world.ribs:
        assert place_in(world, rib, flow.topic.name, node) == to
    flow.outlive()


@pytest.mark.parametrize("to", ["nuc4", *nightly("nuc1", "nuc2", "nuc3")])
def test_a_reader_that_moves_reads_on_and_loses_nothing(to: str) -> None:
    flow = flowing(ring())
    flow.stream(200, 0.02, size=100)
    flow.world.network.call(1.0, lambda: flow.world.roam(SERVER, to))
    assert flow.world.network.run(20, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    flow.outlive()


def test_moving_there_and_back_again_ends_where_it_began() -> None:
    flow = flowing(ring())
    network = flow.world.network
    flow.stream(400, 0.02, size=100)
    for at_s, to in enumerate(("nuc2", "nuc5", "nuc1"), start=1):
        network.call(2.0 * at_s, partial(flow.world.roam, ROBOT, to))
    assert network.run(30, lambda: flow.has(SERVER, 400))
    assert flow.numbers(SERVER) == list(range(400))
    assert flow.hops(SERVER)[-1] == 5
    flow.outlive()


def test_a_watcher_is_informed_at_once() -> None:
    flow = flowing(ring())
    world = flow.world
    world.roam(ROBOT, "nuc2")
    assert world.network.run(3, lambda: world.members[ROBOT].attachment.is_attached)
    world.network.run(0.05)
    flow.publish(b"here I am")
    assert world.network.run(0.2, lambda: flow.has(SERVER, 1))
    assert flow.hops(SERVER) == [4]
    flow.outlive()


def test_the_old_branch_is_left_at_once() -> None:
    flow = flowing(ring())
    world = flow.world
    world.roam(ROBOT, "nuc5")
    world.network.run(1)
    tap = Tap("nuc4", "nuc5")
    world.network.taps.append(tap)
    flow.publish(b"short")
    assert world.network.run(1, lambda: flow.has(SERVER, 1))
    assert flow.hops(SERVER) == [1]
    assert tap.count(Kind.DATA) == 0
    assert not world.switches["nuc3"].multicast.trees.all()
    flow.outlive()


def test_a_new_incarnation_of_a_publisher_is_read_from_its_start() -> None:
    flow = flowing(ring())
    world = flow.world
    flow.publish(b"first life")
    assert world.network.run(1, lambda: flow.has(SERVER, 1))
    world.network.stop(ROBOT)
    world.network.run(3)
    second = _again(flow)
    second.publish(b"second life")
    assert world.network.run(5, lambda: second.has(SERVER, 2))
    assert [each.message for each in second.got[SERVER]] == [b"first life", b"second life"]
    second.outlive()


def _again(flow: Flow) -> Flow:
    """Restart the robot at another switch, under the same name."""
    world = flow.world
    member = world.restart_member(ROBOT)
    world.roam(ROBOT, "nuc2")
    again = Flow(world, flow.name, ROBOT, flow.topic, member.advertise(flow.topic, b"", reliable=True), flow.got)
    world.network.send_pending(ROBOT)
    assert world.network.run(5, lambda: again.is_read_by(1))
    return again
