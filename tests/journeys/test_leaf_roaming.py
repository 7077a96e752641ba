"""Robot whose own switch is a leaf and moves between switches: make before break, and no transit through it."""

from __future__ import annotations

import pytest

from gdp.frame.codec import Kind
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import Flow, Tap, flowing, outlive_together

LEASE_S = 2.5
ROBOT, DESK, CROWD = "leaf/robot", "desk/operator", "lift/screen"
OVERLAP_S, EVERY_S = 1.0, 0.02


def corridor() -> Simulation:
    """Return a row of switches; a robot's leaf hangs on the first one: desk (RIB) -- hall -- lift, leaf at hall."""
    topology = Topology(
        links=(Link("desk", "hall"), Link("hall", "lift"), Link("hall", "leaf")),
        domains=(DomainPlan("building", ("desk", "hall", "lift", "leaf")),),
        attachments=(
            Attachment("desk", "rib", "rib"), Attachment("desk", "proxy", "operator"),
            Attachment("lift", "proxy", "screen"), Attachment("leaf", "proxy", "robot"),
        ),
    )  # fmt: skip
    world = Simulation(topology=topology, lease_s=LEASE_S, leaves=("leaf",))
    assert world.run_until_attached()
    return world


def drive(world: Simulation, flows: list[Flow], stops: tuple[str, ...]) -> None:
    """Link the leaf to each stop in turn; the previous link is pulled ``OVERLAP_S`` after the next one is added."""
    network, sim_link = world.network, world.cables[frozenset(("hall", "leaf"))]
    count = int((len(stops) + 1) * 3.0 / EVERY_S)
    for flow in flows:
        flow.stream(count, EVERY_S, size=100)
    network.run(1.0)
    for stop in stops:
        joined = network.connect("leaf", stop, SimLink(0.0005))
        network.run(OVERLAP_S)
        network.set_link(sim_link, up=False)
        sim_link = joined
        network.run(2.0)
    for flow in flows:
        for reader in flow.got:
            assert network.run(20, lambda: flow.has(reader, count)), (flow.name, reader, len(flow.got[reader]))  # noqa: B023
            assert flow.numbers(reader) == list(range(count))


@pytest.mark.parametrize("stops", [("desk", "lift", "hall"), pytest.param(("lift",), marks=pytest.mark.nightly)])
def test_a_leaf_that_roams_with_both_links_up_loses_nothing_of_its_nodes(stops: tuple[str, ...]) -> None:
    world = corridor()
    camera = flowing(world, "/camera", ROBOT, (DESK, CROWD))
    command = flowing(world, "/cmd_vel", DESK, (ROBOT,))
    drive(world, [camera, command], stops)
    camera.outlive()
    command.outlive()


def test_between_two_uplinks_a_leaf_passes_nothing_even_where_that_is_shorter() -> None:
    world = corridor()
    others = flowing(world, "/news", DESK, (CROWD,))
    world.network.connect("leaf", "desk", SimLink(0.0005), 1)
    world.network.connect("leaf", "lift", SimLink(0.0005), 1)  # desk - leaf - lift costs 2, desk - hall - lift 20
    world.network.run(2.0)
    taps = [Tap("leaf", to) for to in ("desk", "hall", "lift")]
    world.network.taps += taps
    others.stream(50, EVERY_S)
    assert world.network.run(5, lambda: others.has(CROWD, 50))
    assert sum(tap.count(Kind.DATA) for tap in taps) == 0
    assert set(others.hops(CROWD)) == {3}
    own = flowing(world, "/pose", ROBOT, (DESK, CROWD))
    own.stream(50, EVERY_S)
    assert world.network.run(5, lambda: own.has(DESK, 50) and own.has(CROWD, 50))
    assert set(own.hops(DESK)) == set(own.hops(CROWD)) == {2}
    outlive_together(own, others)
