"""Recorded queries, advertisements and responses between switches and RIBs, replayed by a stranger without effect."""

from __future__ import annotations

from gdp.errors import DropReason
from gdp.frame.codec import Header, Kind, encode
from gdp.limits import HOPS_MAX
from gdp.names import Name
from lab.simulation import Simulation
from tests.journeys.flows import SERVER, Tap, advertise, flowing, ring
from tests.journeys.test_attacks import mac_of, still_flows


def at_rib(world: Simulation) -> tuple[str, Tap, Tap]:
    """Return a RIB's node, and the frames to it and from it from now on."""
    node = world.rib_node("school")
    switch = node.partition("/")[0]
    there, back = Tap(switch, node), Tap(node, switch)
    world.network.taps += [there, back]
    return node, there, back


def played(world: Simulation, node: str, frames: list[bytes], times: int = 1) -> int:
    """Play frames to a node over its link; return their size in bytes."""
    for _ in range(times):
        for frame in frames:
            world.network.inject(node, 0, frame, mac_of(world, node))
        world.network.run(0.01)
    world.network.run(0.5)
    return times * sum(map(len, frames))


def of_rib(tap: Tap) -> list[bytes]:
    return [frame for frame in tap.frames if frame[1] in (Kind.RIB_REQUEST, Kind.RIB_ANSWER)]


def test_a12_a13_recorded_questions_and_advertisements_draw_no_more_than_their_own_bytes() -> None:
    world = ring(lease_s=60.0)  # nothing is renewed during this time
    node, there, back = at_rib(world)
    flow = flowing(world)
    for number in range(5):
        advertise(world, f"/more{number}")
    world.network.run(3)
    recorded = of_rib(there)
    assert len(recorded) > 20
    back.frames.clear()
    rib = world.ribs["school"]
    accepted, answers = rib.rib.state.accepted, rib.rib.state.outbox.answers
    spent = played(world, node, recorded, times=20)
    assert sum(map(len, of_rib(back))) <= spent / 10
    assert (rib.rib.state.accepted, rib.rib.state.outbox.answers) == (accepted, answers)
    assert rib.drops()[DropReason.REPLAYED] >= 20
    still_flows(flow)


def test_a39_a_rib_that_restarted_takes_no_advertisement_that_a_stranger_recorded() -> None:
    world = ring()
    node, there, _ = at_rib(world)
    flow = flowing(world)
    world.network.run(1)
    recorded = of_rib(there)
    world.network.freeze(node.partition("/")[0])  # only the stranger speaks to it
    world.kill_rib("school")
    rib = world.restart_rib("school")
    world.network.thaw(node.partition("/")[0])
    assert world.network.run(10, lambda: rib.attachment.is_attached)
    before = rib.rib.state.accepted
    taken: list[int] = []
    for _ in range(3):
        played(world, node, recorded)
        taken.append(rib.rib.state.accepted - before)
    assert rib.drops()[DropReason.NO_CHANNEL] >= len(recorded) // 4
    assert rib.rib.state.refusals[DropReason.STALE] == 0  # no old advertisement came that far
    still_flows(flow)
    flow.outlive()


def test_an_old_negative_response_delays_no_message() -> None:
    world = ring()
    tap = Tap("nuc4", "nuc5")
    world.network.taps.append(tap)
    flow = flowing(world)
    name = Name(bytes(range(32)))
    frame, port = _to(world, name), _port_of(world, "nuc5", SERVER)
    for _ in range(3):
        world.network.inject("nuc5", port, frame, mac_of(world, "nuc5", port))
        world.network.run(1)
    negative = of_rib(tap)
    assert negative
    flow.collect()
    before = len(flow.got[SERVER])
    drops = world.switches["nuc5"].drops()[DropReason.REPLAYED]
    for number in range(20):
        for each in negative:
            world.network.inject("nuc5", 0, each, mac_of(world, "nuc5"))
        flow.publish(b"message %d" % number)
        world.network.run(0.05)
    assert world.network.run(2, lambda: flow.has(SERVER, before + 20))
    assert world.switches["nuc5"].drops()[DropReason.REPLAYED] - drops >= 20
    flow.outlive()


def _port_of(world: Simulation, switch: str, label: str) -> int:
    ports = world.network._nodes[switch].ports
    return next(port for port, (_, _, far) in ports.items() if far.node == label)


def _to(world: Simulation, name: Name) -> bytes:
    """Return a frame of the server to an invented name."""
    return encode(Header(Kind.DATA, 0, HOPS_MAX, 0, 4, 1, 0, 1, 9, name, world.members[SERVER].name)) + b"data"
