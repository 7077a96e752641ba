"""Links that fall silent, lose frames or flap, and the traffic that continues during the fault."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil

import pytest

from gdp.frame.codec import Header, Kind, encode
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import DomainPlan, Link, Topology
from tests.journeys.flows import LEASE_S, LEASES

SQUARE = Topology(
    (Link("a", "b", 10), Link("a", "c", 10), Link("b", "d", 10), Link("c", "d", 15)),
    (DomainPlan("home", ("a", "b", "c", "d")),),
    (),
)
DETECT_S = 0.21


def square() -> Simulation:
    """Return four switches in a ring, with their alternates."""
    world = Simulation(topology=SQUARE, lease_s=LEASE_S, keepalive_ms=None)
    world.network.run(3.0)
    return world


def stays(world: Simulation, holds: Callable[[], bool]) -> None:
    """Check that something holds until three leases are over."""
    for _ in range(ceil(LEASES * world.lease_s / 0.5)):
        assert holds()
        world.network.run(0.5)
    assert holds()


def sim_link(world: Simulation, one: str, two: str) -> SimLink:
    return world.cables[frozenset((one, two))]


def neighbours(world: Simulation, switch: str) -> set[str]:
    """Return the neighbours of a switch that are up."""
    label_of = {each.name: label for label, each in world.switches.items()}
    return {label_of[each.name] for each in world.switches[switch].hello_protocol.neighbours.all_up()}


def is_whole(world: Simulation) -> bool:
    """Return whether every switch of the square has both its neighbours."""
    return [neighbours(world, each) for each in "abcd"] == [{"b", "c"}, {"a", "d"}, {"a", "d"}, {"b", "c"}]


def echo(world: Simulation) -> bytes:
    """Return a frame for switch d in the name of switch a."""
    a, d = (world.switches[each].name for each in "ad")
    return encode(Header(Kind.ECHO_REQUEST, 0, 64, 0, 0, 1, 0, 1, 7, d, a))


def passed(world: Simulation, one: str, two: str) -> list[float]:
    """Return the times at which echo requests pass a link from now on."""
    seen: list[float] = []

    def tap(now_s: float, source: str, target: str, frame: bytes) -> None:
        if (source, target) == (one, two) and frame[15] == Kind.ECHO_REQUEST:
            seen.append(now_s)

    world.network.taps.append(tap)
    return seen


def send_to_d(world: Simulation) -> None:
    """Let a frame come in at a as from its neighbour c."""
    port, (_, own, far) = next(
        (port, wired) for port, wired in world.network._nodes["a"].ports.items() if wired[2].node == "c"
    )
    del own
    world.network.inject("a", port, echo(world), far.mac)


def test_a_silent_cut_is_noticed_by_both_ends_within_the_detection_time() -> None:
    world = square()
    sim_link(world, "a", "b").loss = 1.0
    world.network.run(DETECT_S + 0.02)
    stays(world, lambda: (neighbours(world, "a"), neighbours(world, "b")) == ({"c"}, {"d"}))


def test_a_link_that_loses_frames_one_way_is_given_up_by_both_ends() -> None:
    world = square()
    wire = sim_link(world, "a", "b")
    send = world.network._send
    a = world.network._nodes["a"]

    def lossy(wired: tuple, frame: bytes) -> None:  # type: ignore[type-arg]
        if wired[0] is not wire or wired[1].node != "a":
            send(wired, frame)

    world.network._send = lossy  # type: ignore[method-assign]
    assert a.is_alive
    world.network.run(DETECT_S + 0.05)
    stays(world, lambda: (neighbours(world, "a"), neighbours(world, "b")) == ({"c"}, {"d"}))


def test_five_percent_of_loss_lose_no_neighbour() -> None:
    world = square()
    for each in world.cables.values():
        each.loss = 0.05
    for _ in range(60):
        world.network.run(0.5)
        assert is_whole(world)


def test_a_frozen_switch_is_let_go_and_comes_back_cleanly() -> None:
    world = square()
    world.network.freeze("b")
    world.network.run(5.0)
    assert neighbours(world, "a") == {"c"}
    world.network.thaw("b")
    world.network.run(2.0)
    stays(world, lambda: is_whole(world))


@pytest.mark.momentary("the one frame between the cut and its discovery is what this is about")
def test_frames_take_the_alternate_before_the_switch_itself_knows_of_the_cut() -> None:
    world = square()
    by_b, by_c = passed(world, "a", "b"), passed(world, "a", "c")
    send_to_d(world)
    world.network.run(0.5)
    assert (len(by_b), len(by_c)) == (1, 0)
    sim_link(world, "a", "b").is_up = False  # the port is down; the machine has received no event
    send_to_d(world)
    assert (len(by_b), len(by_c)) == (1, 1)


def test_a_link_that_flaps_is_left_out_until_it_stays() -> None:
    world = square()
    wire = sim_link(world, "a", "b")
    for _ in range(8):
        world.network.set_link(wire, up=False)
        world.network.run(0.1)
        world.network.set_link(wire, up=True)
        world.network.run(0.2)
    world.network.run(1.0)
    a, b = world.switches["a"], world.switches["b"]
    assert neighbours(world, "a") == {"b", "c"}
    allowed = frozenset({a.state.identity.member.domain})
    way = a.paths.to_switch(b.name, a.state.identity.member.domain, allowed)
    assert way is not None
    assert way.first == world.switches["c"].name
    world.network.run(12.0)
    way = a.paths.to_switch(b.name, a.state.identity.member.domain, allowed)
    assert way is not None
    assert way.first == b.name
    stays(world, lambda: neighbours(world, "a") == {"b", "c"})
