"""Statement that a trusted member signs, shaped to end each node that receives or forwards it: no node ends."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gdp.control.boundary import ErrorBoundary
from gdp.control.link_state import LINKS_MAX, MEMBERS_MAX, RIBS_MAX, Adjacency, AttachedRib, LinkState, Scope
from gdp.control.rib_statements import AdvertiseAck
from gdp.crypto.statements import StatementType, parse, sign
from gdp.crypto.validity import Validity
from gdp.errors import DropReason
from gdp.frame.codec import Flag, Header, Kind, encode
from gdp.limits import ADVERTISEMENT_MAX_BYTES, CONTROL_MAX_BYTES, HOPS_MAX, WITHDRAWAL_MAX_BYTES
from gdp.names import ZERO, Name
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, flowing, ring
from tests.journeys.test_attacks import control, mac_of, still_flows

PADDINGS = (ADVERTISEMENT_MAX_BYTES - 2_000, 12_000, 13_000, 14_000, 15_000)


def padded(world: Simulation, wire: bytes, size: int) -> bytes:
    """Return a statement of the robot's with an additional value under a key that no node reads."""
    statement, robot = parse(wire), world.identities[ROBOT]
    body = {**statement.fields, "zz": b""}
    wide = sign(statement.type, body, robot.name, robot.key)
    return sign(statement.type, {**body, "zz": bytes(max(size - len(wide) - 2, 0))}, robot.name, robot.key)


def say(world: Simulation, kind: Kind, wire: bytes, number: int) -> None:
    """Let the robot send a statement to its switch, in as many frames as needed."""
    parts = [wire[at : at + 1_300] for at in range(0, len(wire), 1_300)]
    for part, chunk in enumerate(parts):
        flags = Flag.LAST if part == len(parts) - 1 else Flag.NONE
        source = world.identities[ROBOT].name
        header = Header(kind, flags, HOPS_MAX, 0, len(chunk), number, part, len(parts), 9, ZERO, source)
        world.network.inject("nuc1", 2, encode(header) + chunk, mac_of(world, "nuc1", 2))


@pytest.mark.parametrize("kind", [Kind.ADVERTISE, Kind.WITHDRAW])
def test_a01_a02_a40_no_advertisement_or_withdrawal_of_any_size_ends_a_switch_or_a_rib(kind: Kind) -> None:
    world = ring()
    flow = flowing(world)
    robot = world.identities[ROBOT]
    wire = sign(StatementType.WITHDRAW, {"n": robot.name, "right": "read", "s": 1 << 40}, robot.name, robot.key)
    if kind is Kind.ADVERTISE:
        now_s = world.network.now.unix_s
        rtcert = RtCert.make(robot, world.identities["nuc1"].name, Validity.lasting(now_s, 600))
        wire = UnverifiedAdvertisement(
            subject=robot.subject,
            right=Right.ATTACH,
            rtcert=rtcert,
            sequence=int(now_s * 1_000) + 60_000,
            incarnation=9,
            lease_ms=20_000,
            is_global=True,
        ).signed(robot)
    for number, size in enumerate(PADDINGS, 1 << 30):
        say(world, kind, padded(world, wire, size), number)
        world.network.run(0.2)
    world.network.run(1)
    limit = ADVERTISEMENT_MAX_BYTES if kind is Kind.ADVERTISE else WITHDRAWAL_MAX_BYTES
    assert world.switches["nuc1"].drops()[DropReason.TOO_BIG] == sum(size > limit for size in PADDINGS)
    still_flows(flow)
    flow.outlive()


def test_a70_a_link_state_of_a_rib_called_zero_is_malformed() -> None:
    world = ring()
    flow = flowing(world)
    liar = world.identities["nuc2"]
    state = LinkState(
        origin=liar.name,
        domain=liar.root.domain,
        scope=Scope.BORDER,
        sequence=int(world.network.now.unix_s * 1_000) + 1,
        links=(),
        inside=(),
        ribs=(AttachedRib(ZERO, liar.root.domain, bytes(8)),),
        said_unix_s=int(world.network.now.unix_s),
    )
    world.network.inject(
        "nuc1", 0, control(Kind.LINK_STATE, state.to_wire(liar.name, liar.key, liar.membership)), mac_of(world, "nuc1")
    )
    assert world.switches["nuc1"].drops()[DropReason.MALFORMED] == 1
    still_flows(flow)


@pytest.mark.parametrize("sequence", [(1 << 64) - 1, 1 << 60])
def test_a23_a71_an_ack_of_a_giant_number_ends_no_proxy(sequence: int) -> None:
    world = ring()
    flow = flowing(world)
    rib, robot = world.identities["rib:school"], world.members[ROBOT]
    ack = AdvertiseAck(flow.topic.name, robot.name, DropReason.STALE, sequence)
    wire = ack.to_wire(rib.name, rib.key, rib.membership)
    world.network.inject(ROBOT, 0, control(Kind.ADVERTISE_ACK, wire), mac_of(world, ROBOT))
    assert robot.drops()[DropReason.MALFORMED] == 1
    still_flows(flow)
    flow.outlive()


def test_a64_a_link_state_of_more_than_fits_is_cut_and_ends_no_switch() -> None:
    world = ring()
    nuc1 = world.identities["nuc1"]

    def names(count: int) -> list[Name]:
        return [Name(bytes([1 + each % 255, each // 255]) * 16) for each in range(count)]

    links = tuple(Adjacency(name, nuc1.root.domain, 1 << 24, 9_000) for name in names(LINKS_MAX))
    proof = {"membership": bytes(700), "rtcert": bytes(300)}
    ribs = tuple(AttachedRib(name, nuc1.root.domain, bytes(8), **proof) for name in names(RIBS_MAX))
    state = LinkState(
        origin=nuc1.name,
        domain=nuc1.root.domain,
        scope=Scope.BORDER,
        sequence=1,
        links=links,
        inside=links,
        ribs=ribs,
        members=tuple(names(MEMBERS_MAX)),
        refused=tuple(names(RIBS_MAX)),
    ).fitted(nuc1.membership)
    wire = state.to_wire(nuc1.name, nuc1.key, nuc1.membership)
    assert len(wire) <= CONTROL_MAX_BYTES
    read = LinkState.from_origin(parse(wire).fields, nuc1.name, nuc1.root.domain)
    assert read == state
    assert len(read.ribs) > 4
    assert len(read.links) > 64
    assert read.is_partial


@pytest.fixture
def contained() -> Iterator[None]:
    ErrorBoundary.reraises = False
    yield
    ErrorBoundary.reraises = True


@pytest.mark.usefixtures("contained")
def test_an_error_of_ours_is_contained_counted_logged_once_and_its_sender_quarantined(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = ring()
    flow = flowing(world)
    nuc1 = world.switches["nuc1"]

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a fault of ours")

    robot = world.identities[ROBOT]
    wire = sign(StatementType.ADVERTISE, {}, robot.name, robot.key)
    with monkeypatch.context() as patch:
        patch.setitem(nuc1._handlers, Kind.ADVERTISE, broken)
        for number in range(6):
            say(world, Kind.ADVERTISE, wire, (1 << 40) + number)
    assert nuc1.drops()[DropReason.INTERNAL] == 3
    assert nuc1.drops()[DropReason.QUARANTINED] == 3
    (text,) = nuc1.boundary.poll_tracebacks()
    assert "a fault of ours" in text
    still_flows(flow)
    world.network.run(11)
    say(world, Kind.ADVERTISE, wire, 1 << 41)
    assert nuc1.drops()[DropReason.QUARANTINED] >= 3
    assert nuc1.drops()[DropReason.MALFORMED] == 1
