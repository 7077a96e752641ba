"""Quotas of one member: its watches, advertisements, names, queries and branches leave capacity for the others."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest

from gdp.control.fragments import ControlFragmenter
from gdp.control.join import Join
from gdp.control.link_state import LinkState, Scope
from gdp.control.rib_statements import Query, RelayedStatement
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Header, Kind, encode
from gdp.intervals import Rate
from gdp.limits import ATTACHED_MAX, HOPS_MAX, QUESTIONS_RATE
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.sansio import Timestamps
from gdp.switch.local_advertisements import LocalAdvertisements
from gdp.trust.advertisement import Advertisement, UnverifiedAdvertisement
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from lab.simulation import Simulation
from tests.gdp.trust.world import CLOUD, DAY, GATEWAY, NOW, ROBOT, SCHOOL, SWITCH, advertisement, verifier
from tests.journeys.flows import ROBOT as ROBOT_AT
from tests.journeys.flows import SERVER, Tap, advertise, flowing, ring
from tests.journeys.test_attacks import mac_of, still_flows

RIB = NodeKeys.generate(Role.RIB, "rib").join(SCHOOL, DAY)
CLOUD_SWITCH = NodeKeys.generate(Role.SWITCH, "nuc4").join(CLOUD, DAY)
CLOUD_PROXY = NodeKeys.generate(Role.PROXY, "elsewhere").join(CLOUD, DAY)
START = Timestamps(0.0, NOW)
LIMIT = 64  # limit of branches, in a test of how they are shared


def rib(**settings: int) -> RibCore:
    return RibCore(RIB, Policy(SCHOOL.root, [CLOUD.root]), MemoryStore(), replace(RibSettings(), **settings))  # type: ignore[arg-type]


def watch(at: RibCore, by: Identity, number: int) -> None:
    query = Query(Name(number.to_bytes(32, "big")), 3_600.0)
    at.receive(query.to_wire(by.name, by.key, by.membership), by.name, START)
    at.statements_to_send()


def test_a14_a_greedy_client_leaves_capacity_for_the_watches_of_others() -> None:
    at = rib(watches=100)
    for number in range(1, 200):
        watch(at, CLOUD_SWITCH, number)
    assert len(at.state.outbox.watches) == 50
    for number in range(1, 20):
        watch(at, SWITCH, number)
    assert len(at.state.outbox.watches) == 69


def test_a14_a_proxy_watches_nothing_at_a_rib() -> None:
    at = rib()
    watch(at, CLOUD_PROXY, 1)
    assert (len(at.state.outbox.watches), at.state.refusals) == (0, {DropReason.NOT_DELEGATED: 1})


def test_a12_what_a_members_questions_draw_from_a_rib_is_paced_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.rib.state.ANSWER_BYTES_RATE", Rate(1_000.0, burst=30_000.0))
    at = rib()
    for number in range(3):
        tell(at, advertisement(subject=_subject(f"/own{number}"), chain=[]))
    at.statements_to_send()
    name = _subject("/own1").name
    for by in (SWITCH, CLOUD_SWITCH):
        drawn = said = 0
        for _ in range(100):
            wire = Query(name, 0.0).to_wire(by.name, by.key, by.membership)
            at.receive(wire, by.name, START)
            said += len(wire)
            drawn += sum(len(outgoing.statement) for outgoing in at.statements_to_send())
        assert 15_000 < drawn <= 30_000 < said
    assert at.state.refusals[DropReason.QUOTA] >= 150


def test_a07_link_states_of_one_origin_are_flooded_at_a_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.switch.flooding.LINK_STATES_RATE", Rate(10.0, burst=20.0))
    world = ring()
    flow = flowing(world)
    liar, sequence = world.identities["nuc2"], int(world.network.now.unix_s * 1_000) + 100_000
    tap = Tap("nuc1", "nuc5")
    world.network.taps.append(tap)
    for number in range(200):
        state = LinkState(
            origin=liar.name,
            domain=liar.root.domain,
            scope=Scope.BORDER,
            sequence=sequence + number,
            links=(),
            inside=(),
            ribs=(),
            said_unix_s=int(world.network.now.unix_s),
        )
        frames = ControlFragmenter(liar.name, 1 << 40).split(
            Kind.LINK_STATE, state.to_wire(liar.name, liar.key, liar.membership), 1_400
        )
        for frame in frames:
            world.network.inject("nuc1", _port_of(world, "nuc1", "nuc2"), frame, mac_of(world, "nuc1", 0))
    assert 0 < tap.count(Kind.LINK_STATE) <= 21
    assert world.switches["nuc1"].drops()[DropReason.QUOTA] >= 170
    world.network.run(15)
    still_flows(flow)
    flow.outlive()


def test_a15_a_nodes_advertisements_are_bounded_and_cost_the_same_however_many_there_are() -> None:
    attached = LocalAdvertisements()
    one = verifier().verify(advertisement(subject=_subject("/own"), chain=[], lease_s=3_600.0), NOW)
    for number in range(1, ATTACHED_MAX // 2 + 1):
        attached.put(renamed(one, Name(number.to_bytes(32, "big"))), 0, b"m", 0.0)
    with pytest.raises(StatementError, match="quota"):
        attached.put(one, 0, b"m", 0.0)
    rtcert = RtCert.make(GATEWAY, SWITCH.name, DAY)
    others = advertisement(node=GATEWAY, subject=_subject("/others", GATEWAY), chain=[], rtcert=rtcert)
    attached.put(verifier().verify(others, NOW), 1, b"n", 0.0)
    assert len(attached.due(0.0, 0.0)) == ATTACHED_MAX // 2 + 1
    assert attached.due(0.1, 0.0) == []


def test_a15_advertisements_and_withdrawals_beyond_a_neighbours_pace_draw_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gdp.switch.advertisements.ADVERTISEMENTS_RATE", Rate(10.0, burst=20.0))
    world = ring()
    other = world.add_member("nuc1/other", "nuc1")
    assert world.network.run(5, lambda: other.attachment.is_attached)
    nuc1, robot = world.switches["nuc1"], world.identities[ROBOT_AT]
    incarnation = world.members[ROBOT_AT].attachment._incarnation
    sequence = int(world.network.now.unix_s * 1_000) + 100_000
    rtcert = RtCert.make(robot, nuc1.name, Validity.lasting(world.network.now.unix_s, 600))
    port = _port_of(world, "nuc1", ROBOT_AT)
    tap = Tap("nuc1", "nuc2")
    world.network.taps.append(tap)

    def say(numbers: range) -> int:
        before = len(tap.frames)
        for number in numbers:
            wire = UnverifiedAdvertisement(
                subject=_subject(f"/own{number}", robot),
                right=Right.PUBLISH,
                rtcert=rtcert,
                sequence=sequence + number,
                incarnation=incarnation,
                lease_ms=20_000,
                is_global=True,
            ).signed(robot)
            for frame in ControlFragmenter(robot.name, number).split(Kind.ADVERTISE, wire, 1_400):
                world.network.inject("nuc1", port, frame, mac_of(world, "nuc1", port))
        return len(tap.frames) - before

    assert say(range(1, 30)) > 0
    assert say(range(30, 200)) == 0
    assert nuc1.drops()[DropReason.QUOTA] >= 170
    late = advertise(world, "/late", "nuc1/other")
    late.read_by(SERVER)
    assert world.network.run(3, lambda: late.is_read_by(1))
    late.outlive()


def renamed(one: Advertisement, name: Name) -> Advertisement:
    """Return an unverified advertisement of another name: the quota is counted before verification."""
    subject = copy.copy(one.subject)
    object.__setattr__(subject, "name", name)
    return replace(one, subject=subject)


def test_a16_one_nodes_names_leave_capacity_for_the_other_nodes_of_its_switch() -> None:
    at = rib(names_per_sender=20)
    for number in range(30):
        tell(at, advertisement(subject=_subject(f"/own{number}"), chain=[]))
    assert (at.names, at.state.refusals) == (10, {DropReason.QUOTA: 20})
    rtcert = RtCert.make(GATEWAY, SWITCH.name, DAY)
    tell(at, advertisement(node=GATEWAY, subject=_subject("/others", GATEWAY), chain=[], rtcert=rtcert))
    assert at.names == 11


def tell(at: RibCore, wire: bytes) -> None:
    relayed = RelayedStatement(wire, (SCHOOL.root.domain,), SWITCH.membership)
    at.receive(relayed.to_wire(SWITCH.name, SWITCH.key), SWITCH.name, START)


def _subject(name: str, by: Identity = ROBOT) -> Subject:
    return Subject.of(Metadata({"kind": "topic", "name": name}), by.key.public.compressed)


def _frame(world: Simulation, to: Name) -> bytes:
    member = world.members[ROBOT_AT]
    return encode(Header(Kind.DATA, 0, HOPS_MAX, 0, 4, 1, 0, 1, 9, to, member.name)) + b"data"


def _port_of(world: Simulation, switch: str, label: str) -> int:
    ports = world.network._nodes[switch].ports
    return next(port for port, (_, _, far) in ports.items() if far.node == label)


def test_a17_a18_frames_to_invented_names_cause_queries_within_a_budget_and_delay_no_others() -> None:
    world = ring()
    flow = flowing(world)
    other = world.add_member("nuc1/other", "nuc1")
    assert world.network.run(5, lambda: other.attachment.is_attached)
    tap = Tap("nuc1", "nuc2")
    world.network.taps.append(tap)
    port = _port_of(world, "nuc1", ROBOT_AT)
    mac = mac_of(world, "nuc1", port)
    for number in range(1, 5_001):
        world.network.inject("nuc1", port, _frame(world, Name(number.to_bytes(32, "big"))), mac)
        if number % 500 == 0:
            world.network.run(0.05)
    switch = world.switches["nuc1"]
    world.network.run(0.5)
    asked = QUESTIONS_RATE.burst + 2 * 16 * 2
    assert switch.drops()[DropReason.PENDING_FULL] >= 5_000 - asked
    late = advertise(world, "/late", "nuc1/other")
    late.read_by(SERVER)
    assert world.network.run(3, lambda: late.is_read_by(1))
    still_flows(flow)
    flow.outlive()


def test_a65_one_neighbours_branches_leave_capacity_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.switch.multicast.TREES_MAX", LIMIT)
    world = ring()
    multicast = world.switches["nuc1"].multicast
    own = world.switches["nuc1"].name
    domain = world.authorities["school"].root.domain
    greedy, modest = (
        each for each in world.switches["nuc1"].hello_protocol.neighbours.all_up() if each.role is Role.SWITCH
    )
    through = frozenset(world.policy("school").transit)
    for number in range(1, LIMIT // 2 + 1):
        topic = Name(number.to_bytes(32, "big"))
        join = Join(
            topic=topic,
            publisher=own,
            switch=own,
            domain=domain,
            allowed=through,
            mtu=1_400,
            lease_s=7.0,
            evidence=b"claim",
            session=b"",
            sequence=number,
        )
        multicast.join(join, greedy, world.network.now.mono_s)
    with pytest.raises(StatementError, match="quota"):
        multicast.join(replace(join, topic=Name(b"s" * 32)), greedy, world.network.now.mono_s)
    assert len(multicast.trees) == LIMIT // 2
    multicast.join(replace(join, topic=Name(b"t" * 32)), modest, world.network.now.mono_s)
    assert len(multicast.trees) == LIMIT // 2 + 1
