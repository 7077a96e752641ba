"""Paths over links of measured cost: the faster one wins, and noise moves no route."""

from __future__ import annotations

from itertools import pairwise

import pytest

from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.limits import COST_AUTO
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import SERVER, flowing
from tests.lanes import nightly

CABLES = ("s1", "left"), ("left", "s4"), ("s1", "right"), ("right", "s4")
JITTER_S = 0.01
WINS_S = 15.0
FASTER_S = 25.0
SETTLED_S = 30.0
STEP_S = 0.5


def diamond(seed: int = 1, left_s: float = 0.01, right_s: float = 0.01) -> Simulation:
    """Return two parallel paths of noisy links from s1 to s4, each link with this delay one way."""
    nodes = ("s1", "left", "right", "s4")
    world = Simulation(
        topology=Topology(
            tuple(Link(a, b) for a, b in CABLES),
            (DomainPlan("lab", nodes),),
            (Attachment("s4", "rib", "rib"), Attachment("s1", "proxy", "robot")),
        ),
        seed=seed,
        keepalive_ms=None,
    )
    for a, b in CABLES:
        cable = world.cables[frozenset((a, b))]
        cable.delay_s, cable.jitter_s = (left_s if "left" in (a, b) else right_s), JITTER_S
        world.network.set_cost(cable, COST_AUTO)
    assert world.run_until_attached()
    return world


def next_hop(world: Simulation) -> str:
    """Return the switch through which s1 reaches s4."""
    s1, s4 = world.switches["s1"], world.switches["s4"]
    path = s1.paths.to_switch(s4.name, s1.state.policy.own, frozenset((s1.state.policy.own,)))
    assert path is not None
    return next(label for label, each in world.switches.items() if each.name == path.first)


def next_hops(world: Simulation, duration_s: float) -> list[str]:
    """Let time pass; return the next hop at each step."""
    found = []
    for _ in range(int(duration_s / STEP_S)):
        world.network.run(STEP_S)
        found.append(next_hop(world))
    return found


def slow_down(world: Simulation, via: str, delay_s: float) -> None:
    for a, b in CABLES:
        if via in (a, b):
            world.cables[frozenset((a, b))].delay_s = delay_s


@pytest.mark.parametrize("seed", [1, *nightly(2, 3)])
def test_a_route_over_two_paths_of_equal_noisy_delay_changes_at_most_once_in_two_minutes(seed: int) -> None:
    world = diamond(seed)
    world.network.run(SETTLED_S)
    assert sum(before != after for before, after in pairwise(next_hops(world, 120.0))) <= 1


@pytest.mark.parametrize(("left_s", "right_s", "fast"), [(0.03, 0.01, "right"), *nightly((0.01, 0.03, "left"))])
def test_a_path_three_times_as_fast_wins_as_soon_as_it_is_measured(left_s: float, right_s: float, fast: str) -> None:
    assert set(next_hops(diamond(left_s=left_s, right_s=right_s), 75.0)[2:]) == {fast}


def test_a_path_that_becomes_three_times_as_slow_is_left_within_fifteen_seconds_and_not_taken_again() -> None:
    world = diamond()
    world.network.run(SETTLED_S)
    before = next_hop(world)
    slow_down(world, before, 0.03)
    world.network.run(WINS_S)
    assert before not in next_hops(world, 60.0)


def test_a_path_that_loses_a_third_of_its_frames_is_left() -> None:
    world = diamond()
    world.network.run(SETTLED_S)
    before = next_hop(world)
    for a, b in CABLES:
        if before in (a, b):
            world.cables[frozenset((a, b))].loss = 0.3
    world.network.run(30.0)
    assert before not in next_hops(world, 30.0)


def test_a_fixed_cost_is_used_whatever_the_delay() -> None:
    world = diamond(left_s=0.05)
    for a, b in CABLES:
        world.network.set_cost(world.cables[frozenset((a, b))], 10 if "left" in (a, b) else 20)
    assert set(next_hops(world, 75.0)[2:]) == {"left"}


def test_of_two_uplinks_to_one_switch_the_faster_carries_a_topic_and_a_change_loses_nothing() -> None:
    world = Simulation(
        topology=Topology(
            (Link("nuc1", "nuc5"),),
            (DomainPlan("lab", ("nuc1", "nuc5")),),
            (
                Attachment("nuc5", "rib", "rib"),
                Attachment("nuc1", "proxy", "robot"),
                Attachment("nuc5", "proxy", "server"),
            ),
        )
    )
    first = world.cables[frozenset(("nuc1", "nuc5"))]
    second = world.network.connect("nuc1", "nuc5", SimLink(0.03, JITTER_S), COST_AUTO)
    first.delay_s, first.jitter_s = 0.01, JITTER_S
    world.network.set_cost(first, COST_AUTO)
    ports = {port.mac: port.index for port in world.switches["nuc5"].hello_protocol.ports.values()}
    used: list[tuple[float, int]] = []

    def tap(at_s: float, a: str, b: str, frame: bytes) -> None:
        if (a, b) == ("nuc1", "nuc5") and decode(frame, ETHER_BYTES).kind == Kind.DATA:
            used.append((at_s, ports[frame[:6]]))

    assert world.run_until_attached()
    world.network.taps.append(tap)
    flow = flowing(world)
    begun_s, count = world.network.now.mono_s, 800
    flow.stream(count, 0.1, size=100)
    world.network.run(SETTLED_S)
    first.delay_s, second.delay_s = second.delay_s, first.delay_s
    world.network.run(60.0)
    assert flow.numbers(SERVER) == list(range(count))
    before = {port for at_s, port in used if begun_s + 5.0 < at_s < begun_s + SETTLED_S}
    after = {port for at_s, port in used if at_s > begun_s + SETTLED_S + FASTER_S}
    assert (before, after) == ({min(ports.values())}, {max(ports.values())})
