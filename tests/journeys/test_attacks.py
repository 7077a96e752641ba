"""Attacks of a hostile link: counted under their reason, bounded in memory, and the good flow continues."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable

import pytest

from gdp.client.participant import Participant
from gdp.client.rib_host import RibHost
from gdp.control.join import Join
from gdp.control.rib_statements import AdvertiseAck, Response
from gdp.crypto.certificates import Role
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason
from gdp.frame.codec import HEADER_BYTES, Flag, Header, Kind, decode, encode
from gdp.limits import CONTROL_JOIN_BYTES, CONTROL_PATIENCE_S, HOPS_MAX
from gdp.names import ZERO, Name
from gdp.sansio import ReceivedFrame
from gdp.switch.core import SwitchCore
from gdp.switch.name_resolver import QUERIES_MAX
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Flow, Tap, flowing, row

Injector = Callable[[bytes], None]
NODES = ("nuc1", "nuc2", ROBOT, SERVER, "nuc2/rib")


def counted(world: Simulation) -> Counter[DropReason]:
    """Return all drops anywhere, by reason."""
    total = Counter(world.network.drops)
    machines: list[SwitchCore | RibHost | Participant] = [*world.switches.values(), *world.ribs.values()]
    for machine in [*machines, *world.members.values()]:
        total += Counter(machine.drops())
    return total


def still_flows(flow: Flow) -> None:
    """Publish once more, and check its arrival."""
    flow.collect()
    before = len(flow.got[SERVER])
    flow.publish(b"after the attack")
    assert flow.world.network.run(3, lambda: flow.has(SERVER, before + 1))
    assert flow.got[SERVER][-1].message == b"after the attack"


def attack(flow: Flow, frames: Iterable[bytes], nodes: tuple[str, ...] = NODES) -> Counter[DropReason]:
    """Inject frames at a port of each node while the flow continues; return the increase of the counters."""
    world = flow.world
    before = counted(world)
    for frame in frames:
        for node in nodes:
            world.network.inject(node, 0, frame)
    world.network.run(0.5)
    gained = counted(world)
    gained.subtract(before)
    still_flows(flow)
    return Counter({reason: count for reason, count in gained.items() if count > 0})


def control(kind: int, payload: bytes, *, number: int = 1, parts: int = 1, source: bytes = b"e" * 32) -> bytes:
    flags = Flag.LAST if parts == 1 else 0
    return encode(Header(kind, flags, HOPS_MAX, 0, len(payload), number, 0, parts, 9, ZERO, source)) + payload


def mac_of(world: Simulation, node: str, port: int = 0) -> bytes:
    """Return the address from which a node's neighbour on a port speaks."""
    return world.network._nodes[node].ports[port][2].mac


def recorded(tap: Tap, kind: int) -> list[bytes]:
    return [frame for header, frame in zip(tap.headers, tap.frames, strict=True) if header.kind == kind]


def test_random_bytes_are_counted_and_stop_nothing() -> None:
    chance = random.Random(3)
    flow = flowing(row())
    found = attack(flow, (chance.randbytes(chance.randrange(0, 1_500)) for _ in range(300)))
    assert found[DropReason.TRUNCATED] + found[DropReason.BAD_VERSION] > 1_000
    flow.outlive()


def test_random_bytes_behind_a_good_version_are_counted_and_stop_nothing() -> None:
    chance = random.Random(4)
    flow = flowing(row())
    found = attack(flow, (b"\x01" + chance.randbytes(chance.randrange(95, 600)) for _ in range(300)))
    assert found.total() >= 1_000
    flow.outlive()


def test_headers_of_every_kind_with_rubbish_behind_are_counted() -> None:
    flow = flowing(row())
    found = attack(flow, [control(kind, b"rubbish") for kind in range(256)])
    assert found[DropReason.MALFORMED] > 0
    assert found[DropReason.UNKNOWN_SENDER] > 0
    assert found[DropReason.UNKNOWN_KIND] > 0
    flow.outlive()


def test_truncated_frames_are_counted() -> None:
    flow = flowing(row())
    whole = control(Kind.HELLO, bytes(100))
    found = attack(flow, [whole[:size] for size in range(len(whole))], ("nuc1",))
    assert found == {DropReason.TRUNCATED: len(whole)}
    flow.outlive()


def test_a_part_of_four_thousand_million_costs_nothing() -> None:
    flow = flowing(row())
    frames = [
        encode(Header(kind, 0, HOPS_MAX, 1, 0, 1, 0, 0xFFFF_FFFF, 9, ZERO, b"e" * 32))
        for kind in (Kind.HELLO, Kind.DATA, Kind.ADVERTISE, Kind.RIB_ANSWER)
    ]
    assert attack(flow, frames)[DropReason.BAD_PARTS] >= len(NODES)
    flow.outlive()


@pytest.mark.parametrize("container", [b"\x81", b"\xa1\x61a"])
def test_cbor_nested_a_thousand_deep_is_malformed(container: bytes) -> None:
    flow = flowing(row())
    payload = container * 1_000 + b"\x00"
    head = b"\xd2\x84\x58\x26\xa2\x01\x26\x04\x58\x20" + bytes(32) + b"\xa0\x59" + len(payload).to_bytes(2, "big")
    statement = head + payload + b"\x58\x40" + bytes(64)
    frame = control(Kind.HELLO, statement)
    assert attack(flow, [frame])[DropReason.MALFORMED] == len(NODES)
    flow.outlive()


def test_a_flood_of_beginnings_is_bounded_and_given_back() -> None:
    flow = flowing(row())
    world = flow.world
    frames = (control(Kind.HELLO, bytes(1_000), number=n, parts=3, source=n.to_bytes(32, "big")) for n in range(3_000))
    attack(flow, frames, ("nuc1",))
    assert 0 < world.switches["nuc1"].hello_protocol.reception.held_bytes <= CONTROL_JOIN_BYTES
    world.network.run(CONTROL_PATIENCE_S + 1)
    assert world.switches["nuc1"].hello_protocol.reception.held_bytes == 0
    flow.outlive()


def test_for_strangers_no_statement_but_a_hello_is_begun() -> None:
    flow = flowing(row())
    frames = [control(kind, bytes(1_000), parts=3) for kind in range(Kind.LINK_STATE, Kind.ADVERTISE_ACK + 1)]
    found = attack(flow, frames, ("nuc1", "nuc2"))
    assert found == {DropReason.UNKNOWN_SENDER: 2 * len(frames)}
    assert flow.world.switches["nuc1"]._reassembler.held_bytes == 0
    flow.outlive()


def test_for_strangers_nothing_is_looked_for() -> None:
    flow = flowing(row())
    frames = [
        encode(Header(Kind.DATA, Flag.LAST, HOPS_MAX, 1, 0, 1, 0, 1, 9, n.to_bytes(32, "big"), b"e" * 32))
        for n in range(1_000)
    ]
    found = attack(flow, frames, ("nuc1",))
    assert found == {DropReason.UNKNOWN_SENDER: 1_000}
    assert len(flow.world.switches["nuc1"].resolver.pending) == 0
    flow.outlive()


def test_a_neighbour_that_looks_for_everything_is_bounded() -> None:
    flow = flowing(row())
    world = flow.world
    nuc1 = world.switches["nuc1"]
    port = next(i for i, p in nuc1.hello_protocol.ports.items() if world.members[ROBOT].name in p.neighbours)
    mac = mac_of(world, "nuc1", port)
    for number in range(2 * QUERIES_MAX):
        header = Header(Kind.DATA, Flag.LAST, HOPS_MAX, 1, 0, 1, 0, 1, 9, number.to_bytes(32, "big"), b"e" * 32)
        world.network._nodes["nuc1"].machine.receive([ReceivedFrame(port, mac, encode(header))], world.network.now)
    assert len(nuc1.resolver.requests) <= QUERIES_MAX + 8
    assert nuc1.drops()[DropReason.PENDING_FULL] > 0
    world.network.send_pending("nuc1")
    world.network.run(6)
    assert len(nuc1.resolver.pending) == 0
    still_flows(flow)
    flow.outlive()


def test_recorded_frames_of_every_kind_played_back_later_change_nothing() -> None:
    world = row()
    flow = flowing(world)
    taps = [Tap("nuc2", "nuc1"), Tap(ROBOT, "nuc1"), Tap("nuc5", "nuc2")]
    world.network.taps += taps
    flow.stream(20, 0.02)
    world.network.run(12)
    port = {("nuc2", "nuc1"): ("nuc1", 0), (ROBOT, "nuc1"): ("nuc1", 1), ("nuc5", "nuc2"): ("nuc2", 1)}
    before = counted(world)
    world.network.taps.clear()
    for tap in taps:
        node, at = port[tap.a, tap.b]
        for frame in list(tap.frames):
            world.network.inject(node, at, frame, mac_of(world, node, at))
            world.network.run(0.001)
    assert flow.world.network.run(5, lambda: flow.has(SERVER, 20))
    still_flows(flow)
    gained = counted(world)
    gained.subtract(before)
    assert flow.numbers(SERVER)[:20] == list(range(20))
    assert len(flow.got[SERVER]) == 21
    assert gained[DropReason.REPLAYED] > 20
    flow.outlive()


def test_recorded_leaves_played_back_again_and_again_cut_no_branch() -> None:
    world = row()
    first = flowing(world)
    tap = Tap("nuc2", "nuc1")
    world.network.taps.append(tap)
    world.members[SERVER].leave()
    world.network.send_pending(SERVER)
    world.network.run(10)
    leaves = recorded(tap, Kind.LEAVE)
    assert leaves
    world.restart_member(SERVER)
    world.network.run(3)
    flow = Flow(world, first.name, ROBOT, first.topic, first.publisher)
    flow.read_by(SERVER)
    assert world.network.run(10, lambda: flow.is_read_by(1))
    flow.stream(100, 0.01, size=100)
    for _ in range(100):
        world.network.inject("nuc1", 0, leaves[0], mac_of(world, "nuc1"))
        world.network.run(0.01)
    world.network.run(0.1)
    assert flow.numbers(SERVER) == list(range(100))
    assert world.switches["nuc1"].drops()[DropReason.REPLAYED] >= 100
    flow.outlive()


def test_a_recorded_withdrawal_takes_nothing_down_once_the_name_is_advertised_again() -> None:
    world = row()
    tap = Tap(ROBOT, "nuc1")
    world.network.taps.append(tap)
    flow = flowing(world)
    world.members[ROBOT].leave()
    world.network.send_pending(ROBOT)
    world.network.run(1)
    withdrawals = recorded(tap, Kind.WITHDRAW)
    assert withdrawals
    member = world.restart_member(ROBOT)
    publisher = member.advertise(flow.topic, b"", reliable=True)
    flow = Flow(world, flow.name, ROBOT, flow.topic, publisher, flow.got)
    assert world.network.run(10, lambda: flow.is_read_by(1))
    for frame in withdrawals:
        world.network.inject("nuc1", 1, frame, mac_of(world, "nuc1", 1))
    assert world.switches["nuc1"].drops()[DropReason.STALE] >= len(withdrawals)
    still_flows(flow)
    flow.outlive()


def regions(frame: bytes) -> list[int]:
    """Return places that hit every field of the header and every part of the statement behind it."""
    return [*range(HEADER_BYTES), *range(HEADER_BYTES, len(frame), 7)]


@pytest.mark.real_signatures
@pytest.mark.parametrize("kind", [Kind.HELLO, Kind.JOIN, Kind.LINK_STATE])
def test_a_statement_altered_anywhere_is_not_believed(kind: Kind) -> None:
    world = row()
    tap = Tap("nuc2", "nuc1")
    world.network.taps.append(tap)
    flow = flowing(world)
    world.network.run(31 if kind == Kind.LINK_STATE else 9)  # long enough for its renewal
    sample = recorded(tap, kind)[-1]
    state = world.switches["nuc1"]
    neighbours = [(n.name, n.mac) for n in state.hello_protocol.neighbours.all_up()]
    trees = [(tree.key, sorted(tree.branches)) for tree in state.multicast.trees.all()]
    for at in regions(sample):
        altered = bytearray(sample)
        altered[at] ^= 0x41
        world.network.inject("nuc1", 0, bytes(altered), mac_of(world, "nuc1"))
    assert [(n.name, n.mac) for n in state.hello_protocol.neighbours.all_up()] == neighbours
    assert [(tree.key, sorted(tree.branches)) for tree in state.multicast.trees.all()] == trees
    assert sum(state.drops().values()) > 0
    still_flows(flow)
    flow.outlive()


@pytest.mark.real_signatures
def test_altered_parts_of_messages_die_and_the_message_arrives() -> None:
    world = row()
    tap = Tap("nuc2", "nuc5")
    world.network.taps.append(tap)
    flow = flowing(world)
    flow.publish(b"x" * 3_000)
    assert world.network.run(2, lambda: flow.has(SERVER, 1))
    sample = recorded(tap, Kind.DATA)[0]
    mac = mac_of(world, SERVER)
    for at in regions(sample):
        altered = bytearray(sample)
        altered[at] ^= 0x41
        world.network.inject(SERVER, 0, bytes(altered), mac)
    flow.collect()
    assert len(flow.got[SERVER]) == 1
    still_flows(flow)
    flow.outlive()


@pytest.mark.momentary("the forged join bears the neighbour's own key: what that neighbour says later is older")
def test_a_join_without_evidence_installs_nothing() -> None:
    world = row()
    flow = flowing(world)
    nuc2, nuc1 = world.identities["nuc2"], world.switches["nuc1"]
    secret = Name(b"t" * 32)
    session, neighbour = nuc1.hello_protocol.ports[0].echo, nuc1.hello_protocol.neighbours.get(0, nuc2.name)
    assert neighbour is not None
    domains = frozenset(nuc1.state.policy.transit)
    join = Join(
        topic=secret,
        publisher=world.members[ROBOT].name,
        switch=nuc1.name,
        domain=nuc1.state.policy.own,
        allowed=domains,
        mtu=1_500,
        lease_s=5.0,
        evidence=b"",
        session=session,
        sequence=1 << 60,
        sender_session=neighbour.nonce,
    )
    world.network.inject("nuc1", 0, control(Kind.JOIN, join.to_wire(nuc2.name, nuc2.key)), mac_of(world, "nuc1"))
    assert nuc1.multicast.trees.of_topic(secret) == []
    assert nuc1.drops()[DropReason.MALFORMED] == 1
    still_flows(flow)


@pytest.mark.momentary("the forged join bears the neighbour's own key: what that neighbour says later is older")
def test_a_join_with_evidence_of_another_topic_installs_nothing() -> None:
    world = row()
    flow = flowing(world)
    nuc2, nuc1 = world.identities["nuc2"], world.switches["nuc1"]
    evidence = nuc1.multicast.trees.of_topic(flow.topic.name)[0].evidence
    secret, session = Name(b"t" * 32), nuc1.hello_protocol.ports[0].echo
    neighbour = nuc1.hello_protocol.neighbours.get(0, nuc2.name)
    assert neighbour is not None
    domains = frozenset(nuc1.state.policy.transit)
    join = Join(
        topic=secret,
        publisher=world.members[ROBOT].name,
        switch=nuc1.name,
        domain=nuc1.state.policy.own,
        allowed=domains,
        mtu=1_500,
        lease_s=5.0,
        evidence=evidence,
        session=session,
        sequence=1 << 60,
        sender_session=neighbour.nonce,
    )
    world.network.inject("nuc1", 0, control(Kind.JOIN, join.to_wire(nuc2.name, nuc2.key)), mac_of(world, "nuc1"))
    assert nuc1.multicast.trees.of_topic(secret) == []
    assert nuc1.drops()[DropReason.NOT_DELEGATED] == 1
    still_flows(flow)


def test_an_ack_of_a_member_that_may_not_acknowledge_is_not_accepted() -> None:
    world = row()
    flow = flowing(world)
    liar = world.identity(Role.PROXY, "liar", "school")
    robot = world.members[ROBOT]
    ack = AdvertiseAck(flow.topic.name, robot.name, DropReason.REVOKED, 1).to_wire(liar.name, liar.key, liar.membership)
    world.network.inject(ROBOT, 0, control(Kind.ADVERTISE_ACK, ack), mac_of(world, ROBOT))
    assert robot.drops()[DropReason.BAD_CERTIFICATE] == 1
    assert robot.attachment.is_attached
    assert all(each.refused is None for each in robot.attachment.advertisements)
    still_flows(flow)
    flow.outlive()


def test_an_ack_from_another_address_than_the_switch_is_ignored() -> None:
    world = row()
    flow = flowing(world)
    rib = world.identities["rib:school"]
    robot = world.members[ROBOT]
    ack = AdvertiseAck(flow.topic.name, robot.name, DropReason.REVOKED, 1).to_wire(rib.name, rib.key, rib.membership)
    world.network.inject(ROBOT, 0, control(Kind.ADVERTISE_ACK, ack))
    assert robot.drops()[DropReason.UNKNOWN_SENDER] == 1
    still_flows(flow)
    flow.outlive()


@pytest.mark.parametrize(("role", "domain"), [(Role.PROXY, "school"), (Role.RIB, "cloud"), (Role.SWITCH, "school")])
def test_an_answer_from_no_rib_of_ones_own_is_not_believed(role: Role, domain: str) -> None:
    world = row()
    flow = flowing(world)
    liar = world.identity(role, "liar", domain)
    nuc1 = world.switches["nuc1"]
    name = flow.topic.name
    answer = Response(
        name=name, advertiser=name, advertisement=b"", domain=liar.root.domain, transit=(), lease_s=2.0
    ).to_wire(liar.name, liar.key, liar.membership)
    header = Header(Kind.RIB_ANSWER, Flag.LAST, HOPS_MAX, 0, len(answer), 1, 0, 1, 9, nuc1.name, liar.name)
    world.network.inject("nuc1", 0, encode(header) + answer, mac_of(world, "nuc1"))
    assert nuc1.drops()[DropReason.WRONG_DOMAIN] == 1
    assert attack(flow, [encode(header) + answer], ("nuc1",))[DropReason.UNKNOWN_SENDER] == 1
    flow.outlive()


def test_a_statement_of_no_known_type_is_malformed() -> None:
    flow = flowing(row())
    robot = flow.world.identities[ROBOT]
    wire = sign(StatementType.CARD, {"c": robot.membership}, robot.name, robot.key)
    found = attack(flow, [control(Kind.HELLO, wire)], ("nuc5",))
    assert found == {DropReason.MALFORMED: 1}
    flow.outlive()


def test_an_echo_is_no_longer_than_what_asked_for_it() -> None:
    world = row()
    flow = flowing(world)
    nuc1 = world.switches["nuc1"]
    tap = Tap("nuc1", ROBOT)
    world.network.taps.append(tap)
    robot = world.members[ROBOT].name
    header = Header(Kind.ECHO_REQUEST, Flag.LAST, HOPS_MAX, 0, 32, 1, 0, 1, 9, nuc1.name, robot)
    asked = encode(header) + bytes(32)
    world.network.inject("nuc1", 1, asked, mac_of(world, "nuc1", 1))
    world.network.run(0.1)
    replies = recorded(tap, Kind.ECHO_REPLY)
    assert [len(each) for each in replies] == [len(asked)]
    assert decode(replies[0]).source == nuc1.name
    still_flows(flow)
    flow.outlive()


def test_a_hello_of_a_stranger_is_not_answered() -> None:
    world = row()
    flow = flowing(world)
    tap = Tap("nuc1", "nuc2")
    hello = recorded_hello(row(2))
    world.network.run(0.3)
    world.network.taps.append(tap)
    for _ in range(50):
        world.network.inject("nuc1", 0, hello)
    assert tap.frames == []
    still_flows(flow)
    flow.outlive()


def recorded_hello(world: Simulation) -> bytes:
    """Return a hello of another network's switch, whose root no node here knows."""
    tap = Tap("nuc2", "nuc1")
    world.network.taps.append(tap)
    world.network.run(1)
    return recorded(tap, Kind.HELLO)[0]
