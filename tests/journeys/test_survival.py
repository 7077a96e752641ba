"""Networks that outlive every lease after cuts, partitions, dead RIBs and moves."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest

from gdp.control.waiting import WaitReason
from gdp.frame.codec import Kind
from gdp.intervals import ADVERTISEMENT, RETRY_S
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import ROBOT, SERVER, Flow, Tap, flowing, ring

LONG_S = 3 * ADVERTISEMENT.lease_s + 8
LEASE_S = 6.0  # of names, where the real one would only cost time: that of readers is as long
SHORT_S = 3 * LEASE_S + 8
KEEPALIVE_MS = 1_000  # where no link fails in silence, the real ones would only cost time, too
WIDE_BYTES = 9_000  # MTU of links; how statements of RIBs are split is the subject of other files, and of the ring here
PERIOD_S = 0.25  # between messages: several are published during each fault
NIGHTLY = pytest.mark.nightly  # much like another case, or its mirror image: messages go both ways


def complete(flow: Flow, label: str, count: int, within_s: float) -> None:
    """Advance time until this many messages have come to a reader: all of them, in order, once."""
    flow.world.network.run(within_s, lambda: flow.has(label, count))
    assert flow.numbers(label) == list(range(count))


@pytest.mark.parametrize(
    "cut",
    [
        ("nuc1", "nuc2"),
        ("nuc2", "nuc3"),
        *(pytest.param(each, marks=NIGHTLY) for each in (("nuc3", "nuc4"), ("nuc4", "nuc5"), ("nuc5", "nuc1"))),
    ],
)
def test_any_link_of_the_ring_may_fail_for_ever(cut: tuple[str, str]) -> None:
    world = ring(lease_s=LEASE_S)
    there, back = flowing(world), flowing(world, "/answers", SERVER, (ROBOT,))
    count = int(SHORT_S / PERIOD_S)
    there.stream(count, PERIOD_S, size=100)
    back.stream(count, PERIOD_S, size=100)
    world.network.call(5, lambda: world.network.set_link(world.cables[frozenset(cut)], up=False))
    complete(there, SERVER, count, SHORT_S + 10)
    complete(back, ROBOT, count, 10)


def restart_rib(world: Simulation, label: str) -> None:
    world.restart_rib(label)


def restart_switch(world: Simulation, name: str) -> None:
    world.restart_switch(name)


def three_sites() -> Topology:
    """Return domains a, b and c around top, on two paths, each with two access switches and a border."""
    nodes = {label: (f"{label}0", f"{label}1", f"{label}2") for label in ("a", "b", "c")}
    links = [Link(n[0], each) for n in nodes.values() for each in n[1:]]
    links += [Link(n[1], n[2]) for n in nodes.values()]
    links += [Link(f"{label}0", "t1") for label in nodes] + [Link(f"{label}1", "t2", cost=30) for label in nodes]
    links.append(Link("t1", "t2"))
    return Topology(
        tuple(replace(each, mtu=WIDE_BYTES) for each in links),
        (*(DomainPlan(label, n, upper="top") for label, n in nodes.items()), DomainPlan("top", ("t1", "t2"))),
        (
            *(Attachment(f"{label}0" if label != "top" else "t1", "rib", "rib") for label in (*nodes, "top")),
            Attachment("a1", "proxy", "robot"),
            Attachment("c2", "proxy", "server"),
        ),
    )


A, C = "a1/robot", "c2/server"


def sites(lease_s: float = LEASE_S, keepalive_ms: int = KEEPALIVE_MS) -> Simulation:
    """Return the sites, settled."""
    world = Simulation(topology=three_sites(), lead_mtu=WIDE_BYTES, lease_s=lease_s, keepalive_ms=keepalive_ms)
    assert world.run_until_attached()
    return world


MOVES = {
    "within a domain": ["a2"],
    "to another domain": ["b2"],
    "to and fro": ["b2", "a1"] * 5,
    "through all domains": ["b1", "top", "c1", "a2"],
}
HARDEST = "through all domains"


@pytest.mark.parametrize(
    "moves",
    [pytest.param(moves, id=name, marks=[] if name == HARDEST else NIGHTLY) for name, moves in MOVES.items()],
)
@pytest.mark.parametrize("who", [A, pytest.param(C, marks=NIGHTLY)])
def test_a_node_that_moves_keeps_every_flow(who: str, moves: list[str]) -> None:
    world = sites()
    there, back = flowing(world, source=A, readers=(C,)), flowing(world, "/answers", C, (A,))
    count = int(SHORT_S / PERIOD_S)
    there.stream(count, PERIOD_S, size=100)
    back.stream(count, PERIOD_S, size=100)
    for number, to in enumerate(moves):
        world.network.call(3.0 + number, partial(world.roam, who, "t2" if to == "top" else to))
    complete(there, C, count, SHORT_S + 10)
    complete(back, A, count, 10)


def test_both_ends_may_move_at_once() -> None:
    world = sites()
    flow = flowing(world, source=A, readers=(C,))
    count = int(SHORT_S / PERIOD_S)
    flow.stream(count, PERIOD_S, size=100)
    world.network.call(3.0, lambda: world.roam(A, "b2"))
    world.network.call(3.0, lambda: world.roam(C, "b1"))
    complete(flow, C, count, SHORT_S + 10)


@pytest.mark.parametrize(
    ("who", "to"), [(C, "b2"), *(pytest.param(*each, marks=NIGHTLY) for each in ((A, "a2"), (A, "b2"), (C, "a2")))]
)
def test_a_node_moves_while_all_ribs_are_dead(who: str, to: str) -> None:
    world = sites(ADVERTISEMENT.lease_s)
    there, back = flowing(world, source=A, readers=(C,)), flowing(world, "/answers", C, (A,))
    count = int(LONG_S / PERIOD_S)
    there.stream(count, PERIOD_S, size=100)
    back.stream(count, PERIOD_S, size=100)
    for label in world.ribs:
        world.network.call(2.0, partial(world.kill_rib, label))
    world.network.call(40.0, partial(world.roam, who, to))
    complete(there, C, count, LONG_S + 10)
    complete(back, A, count, 10)


@pytest.mark.parametrize("minutes", [5, pytest.param(10, marks=NIGHTLY)])  # link states live for 100 s
def test_established_flows_go_on_while_all_ribs_are_dead_for_minutes(minutes: int) -> None:
    world = sites(ADVERTISEMENT.lease_s, keepalive_ms=1_500)
    flow = flowing(world, source=A, readers=(C,))
    for label in world.ribs:
        world.kill_rib(label)
    flow.stream(60 * minutes, 1.0, size=100)
    complete(flow, C, 60 * minutes, 60 * minutes + 20)


def test_ribs_that_were_dead_for_long_come_back_without_a_flow_noticing() -> None:
    world = sites(ADVERTISEMENT.lease_s)
    flow = flowing(world, source=A, readers=(C,))
    flow.stream(250, 0.4, size=100)
    for label in world.ribs:
        world.network.call(2.0, partial(world.kill_rib, label))
        world.network.call(46.0, partial(restart_rib, world, label))
    complete(flow, C, 250, 110)


@pytest.mark.parametrize(
    "dead",
    [
        ("a", "b", "c"),
        *(
            pytest.param(each, marks=NIGHTLY)
            for each in (("top",), ("a",), ("c",), ("a", "top"), ("a", "c"), ("c", "top"))
        ),
    ],
    ids=" ".join,
)
def test_flows_outlive_the_death_and_the_return_of_any_ribs(dead: tuple[str, ...]) -> None:
    world = sites()
    there, back = flowing(world, source=A, readers=(C,)), flowing(world, "/answers", C, (A,))
    count = int((SHORT_S + 12) / 0.5)
    there.stream(count, 0.5, size=100)
    back.stream(count, 0.5, size=100)
    for label in dead:
        world.network.call(2.0, partial(world.kill_rib, label))
        world.network.call(SHORT_S, partial(restart_rib, world, label))
    complete(there, C, count, SHORT_S + 15)
    complete(back, A, count, 1)


def test_the_death_of_the_top_rib_ends_no_flow_with_real_leases() -> None:
    world = ring(lease_s=ADVERTISEMENT.lease_s)
    flow = flowing(world)
    world.kill_rib("backbone")
    flow.stream(int(LONG_S), 1.0, size=100)
    complete(flow, SERVER, int(LONG_S), LONG_S + 10)
    below = world.ribs["cloud"].rib
    assert [each.reason for each in below.waits(world.network.now.mono_s)] == [WaitReason.NO_UPPER_RIB]
    restart_rib(world, "backbone")
    assert world.network.run(10, lambda: below.waits(world.network.now.mono_s) == [])


def test_a_publisher_that_dies_while_the_tier_above_is_dead_is_gone_once_that_is_back() -> None:
    world = ring(lease_s=LEASE_S)
    flow = flowing(world)
    world.kill_rib("backbone")
    world.network.run(SHORT_S)
    cloud = world.ribs["cloud"].rib
    world.network.stop(ROBOT)
    world.network.run(SHORT_S)
    assert cloud.state.store.routes(flow.topic.name), "it cannot be known that it is gone"
    restart_rib(world, "backbone")
    world.network.run(SHORT_S)
    assert not cloud.state.store.routes(flow.topic.name)


def three_tiers() -> Topology:
    """Return domains in three tiers, a below m below top, and b below top, each a switch with its RIB."""
    uppers = {"a": "m", "m": "top", "b": "top", "top": None}
    return Topology(
        tuple(Link(*ends, mtu=WIDE_BYTES) for ends in (("a1", "m1"), ("m1", "t1"), ("b1", "t1"))),
        tuple(DomainPlan(label, (f"{label[0]}1",), upper=upper) for label, upper in uppers.items()),
        (
            *(Attachment(f"{label[0]}1", "rib", "rib") for label in uppers),
            *(Attachment(at, "proxy", "member") for at in ("a1", "m1", "b1")),
        ),
    )


@pytest.mark.parametrize("reader", ["b1/member", pytest.param("m1/member", marks=NIGHTLY)])
def test_the_tier_above_the_dead_one_takes_its_place_until_it_returns(reader: str) -> None:
    world = Simulation(topology=three_tiers(), lead_mtu=WIDE_BYTES, lease_s=LEASE_S, keepalive_ms=KEEPALIVE_MS)
    assert world.run_until_attached()
    there = flowing(world, source="a1/member", readers=(reader,))
    back = flowing(world, "/answers", reader, ("a1/member",))
    count = int((SHORT_S + 30) / 0.25)
    there.stream(count, 0.25, size=100)
    back.stream(count, 0.25, size=100)
    world.network.run(2)
    world.kill_rib("m")
    world.network.run(SHORT_S)
    flowing(world, "/new", "a1/member", (reader,))  # ... and new names are found by way of the top
    upstream = world.ribs["a"].rib.state.upstream
    assert upstream.rib == world.identities["rib:top"].name
    restart_rib(world, "m")
    # The first probe tells that its channel ended with the RIB, and the second one comes through the next channel.
    assert world.network.run(2 * RETRY_S + 1, lambda: upstream.rib == world.identities["rib:m"].name)
    complete(there, reader, count, 40)
    complete(back, "a1/member", count, 1)


def test_a_transit_domain_needs_no_rib_of_its_own() -> None:
    topology = Topology(
        (Link("a1", "t1"), Link("t1", "t2"), Link("t2", "b1")),
        (DomainPlan("a", ("a1",)), DomainPlan("t", ("t1", "t2")), DomainPlan("b", ("b1",), upper="a")),
        (
            Attachment("a1", "rib", "rib"),
            Attachment("b1", "rib", "rib"),
            Attachment("a1", "proxy", "robot"),
            Attachment("b1", "proxy", "server"),
        ),
    )
    world = Simulation(topology=topology)
    assert world.run_until_attached()
    world.network.run(9)
    flow = flowing(world, source="a1/robot", readers=("b1/server",))
    count = int(LONG_S / PERIOD_S)
    flow.stream(count, PERIOD_S, size=100)
    world.network.call(10.0, lambda: world.roam("a1/robot", "t2"))  # ... and is found in a domain without one
    complete(flow, "b1/server", count, LONG_S + 10)


def test_a_ring_survives_one_fault_after_the_other() -> None:
    world = ring(lease_s=LEASE_S)
    there, back = flowing(world), flowing(world, "/answers", SERVER, (ROBOT,))
    count = int(LONG_S / PERIOD_S)
    there.stream(count, PERIOD_S, size=100)
    back.stream(count, PERIOD_S, size=100)
    at, network = world.network.call, world.network
    one, two = world.cables[frozenset(("nuc1", "nuc2"))], world.cables[frozenset(("nuc4", "nuc5"))]
    at(5, lambda: network.set_link(one, up=False))
    at(15, lambda: network.set_link(one, up=True))
    at(18, lambda: world.kill_rib("school"))
    at(26, partial(restart_rib, world, "school"))
    at(30, lambda: world.roam(ROBOT, "nuc2"))
    at(36, lambda: network.set_link(two, up=False))
    at(45, lambda: network.stop("nuc3"))
    at(55, partial(restart_switch, world, "nuc3"))
    at(60, lambda: world.roam(ROBOT, "nuc1"))
    complete(there, SERVER, count, LONG_S + 10)
    complete(back, ROBOT, count, 10)


def test_a_node_that_died_is_sought_a_few_times_a_second() -> None:
    world = ring(lease_s=LEASE_S)
    flow = flowing(world)
    flow.publish(b"a reader has to confirm it")
    world.network.run(1.0)
    tap = Tap("nuc1", "nuc2")
    world.network.taps.append(tap)
    world.network.stop(ROBOT)
    world.network.run(SHORT_S)
    assert 0 < tap.count(Kind.RIB_REQUEST) < 10 * SHORT_S


def test_a_switch_at_the_border_of_a_domain_that_never_rests_stays_in_its_own() -> None:
    plan = Topology(
        (Link("a1", "a2"), Link("a2", "b2"), Link("b2", "b1"), Link("a1", "a3"), Link("a3", "b3"), Link("b3", "b1")),
        (DomainPlan("a", ("a1", "a2", "a3")), DomainPlan("b", ("b1", "b2", "b3"), upper="a")),
        (Attachment("a1", "rib", "rib"), Attachment("b1", "rib", "rib")),
    )
    world = Simulation(topology=plan, lease_s=LEASE_S)
    world.network.run(5)
    ribs = {world.ribs[domain].name for domain in ("a", "b")}
    for _ in range(9):  # at each change of the border, and no message in a3's own part of the domain
        world.network.stop("a2")
        world.network.run(1.5)
        world.restart_switch("a2")
        for _ in range(12):
            world.network.run(1)
            assert {world.switches["a3"].rib, world.switches["b3"].rib} == ribs
