"""Endpoint records at a RIB: what is kept, for how long, who receives it, and what is refused with which reason."""

from __future__ import annotations

from itertools import count

import pytest

from gdp.control.endpoints import ENDPOINTS, Candidate, CandidateType, Endpoint, EndpointRecord, item_of, record_in
from gdp.control.rib_statements import RelayedStatement
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType, parse
from gdp.crypto.tunnel_key import TunnelKey
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage
from gdp.exchange.sync_set import line_of, rank_in
from gdp.frame.codec import Kind
from gdp.intervals import ENDPOINT
from gdp.limits import ENDPOINT_RECORDS_RATE
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.rib.endpoints import RibEndpoints
from gdp.rib.outbox import OutgoingStatement
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from tests.gdp.control.members import CLOUD, ELSEWHERE, SCHOOL, UNIX_S, at, node

RIB, PEER, FOREIGN_RIB = node("rib", Role.RIB), node("rib2", Role.RIB), node("rib3", Role.RIB, CLOUD)
ONE, TWO, LEAF = node("nuc1"), node("nuc2"), node("nuc9", Role.LEAF)
FOREIGN = node("nuc4", domain=CLOUD)
HERE = Endpoint("192.0.2.1", 40_000)


def record(of: Identity = ONE, sequence: int = 1, until_unix_s: int = UNIX_S + 600) -> EndpointRecord:
    candidates = (Candidate(0, CandidateType.REFLEXIVE, HERE),)
    keys = (TunnelKey.derive(of.kem).public,)
    return EndpointRecord.make(of, keys, candidates, sequence=sequence, until_unix_s=until_unix_s)


def rib(identity: Identity = RIB, peers: tuple[Name, ...] = ()) -> RibCore:
    return RibCore(identity, Policy(SCHOOL.root, [CLOUD.root]), MemoryStore(), RibSettings(peers=peers))


def give(to: RibCore, wire: bytes, by: Identity = ONE, now_s: float = 0.0) -> list[OutgoingStatement]:
    """Give a RIB a statement that ``by`` sent; return what the RIB sends."""
    to.receive(wire, by.name, at(now_s, UNIX_S + now_s))
    return to.statements_to_send()


def query(by: Identity = TWO, *known: tuple[Name, int]) -> bytes:
    lacking = tuple((name, line_of(name, sequence)) for name, sequence in known or ((ONE.name, 0),))
    return SyncMessage(of=ENDPOINTS, lacking=lacking).to_wire(by.name, by.key, by.membership)


def responses(outgoing: list[OutgoingStatement], to: Identity) -> list[SyncMessage]:
    found = [parse(each.statement) for each in outgoing if each.to == to.name and each.kind is Kind.RIB_ANSWER]
    return [SyncMessage.from_fields(each.expect(StatementType.SYNC)) for each in found]


def kept_sequence(response: SyncMessage) -> int:
    ((_, line),) = response.lacking
    return rank_in(line)


def records_for(outgoing: list[OutgoingStatement], to: Identity) -> list[bytes]:
    return [record_in(item)[0] for response in responses(outgoing, to) for item in response.items]


def equalise(*cores: RibCore, now_s: float = 0.0) -> list[OutgoingStatement]:
    """Let RIBs send each other what they have; return all of it."""
    sent: list[OutgoingStatement] = []
    by_name = {core.state.identity.name: core for core in cores}
    while outgoing := [(core, each) for core in cores for each in tick(core, now_s)]:
        for core, each in outgoing:
            by_name[each.to].receive(each.statement, core.state.identity.name, at(now_s, UNIX_S + now_s))
        sent += [each for _, each in outgoing]
        now_s += 0.01
    return sent


def tick(of: RibCore, now_s: float) -> list[OutgoingStatement]:
    of.handle_timer(at(now_s, UNIX_S + now_s))
    return of.statements_to_send()


@pytest.mark.parametrize("asker", [TWO, LEAF])
def test_a_published_record_reaches_the_switch_that_asks(asker: Identity) -> None:
    core, wire = rib(), record().wire
    (kept,) = responses(give(core, wire), ONE)
    assert (kept_sequence(kept), kept.refused) == (1, None)
    assert records_for(give(core, query(asker), asker), asker) == [wire]


def test_a_record_that_the_asker_has_is_not_sent_again() -> None:
    core = rib()
    give(core, record().wire)
    (answer,) = responses(give(core, query(TWO, (ONE.name, 1)), TWO), TWO)
    assert answer.items == ()


def test_a_newer_record_is_sent_to_its_watchers_at_once_and_twice_more() -> None:
    core = rib()
    give(core, query(), TWO)
    wire = record().wire
    assert records_for(give(core, wire), TWO) == [wire]
    assert records_for(tick(core, 0.4), TWO) == [wire]
    assert records_for(tick(core, 1.0), TWO) == [wire]
    assert records_for(tick(core, 2.0), TWO) == []


def test_a_watch_ends() -> None:
    core = rib()
    give(core, query(), TWO)
    tick(core, 31.0)
    assert records_for(give(core, record().wire, now_s=31.0), TWO) == []


def test_a_record_is_dropped_unless_it_is_renewed() -> None:
    core, wire = rib(), record().wire
    give(core, wire)
    give(core, wire, now_s=40.0)
    tick(core, ENDPOINT.lease_s + 1)
    assert len(core.state.endpoints) == 1
    tick(core, 40.0 + ENDPOINT.lease_s)
    assert len(core.state.endpoints) == 0


def test_a_void_record_is_not_sent() -> None:
    core = rib()
    give(core, record(until_unix_s=UNIX_S + 5).wire)
    assert records_for(give(core, query(), TWO, now_s=6.0), TWO) == []


def test_each_switch_has_one_record() -> None:
    core = rib()
    for sequence in range(1, 6):
        give(core, record(sequence=sequence).wire, now_s=float(sequence))
    assert len(core.state.endpoints) == 1


@pytest.mark.parametrize(
    ("by", "wire", "reason"),
    [
        (ONE, record(sequence=4).wire, DropReason.STALE),
        (ONE, record(sequence=5, until_unix_s=UNIX_S + 601).wire, DropReason.STALE),
        (ONE, record(until_unix_s=UNIX_S - 1).wire, DropReason.EXPIRED),
        (ONE, record(sequence=(UNIX_S + 400 * 86_400) * 1_000).wire, DropReason.MALFORMED),
        (PEER, record(PEER).wire, DropReason.NOT_DELEGATED),
    ],
)
def test_a_refusal_says_why(by: Identity, wire: bytes, reason: DropReason) -> None:
    core = rib()
    give(core, record(sequence=5).wire)
    (answer,) = responses(give(core, wire, by), by)
    assert answer.refused is reason
    assert kept_sequence(answer) == (5 if by is ONE else 0)
    assert core.state.refusals[reason] == 1


def test_a_record_that_another_replays_is_refused() -> None:
    core, wire = rib(), record().wire
    assert give(core, wire, TWO) == []
    relayed = RelayedStatement(wire, (), TWO.membership).to_wire(TWO.name, TWO.key)
    assert give(core, relayed, TWO) == []
    assert len(core.state.endpoints) == 0
    assert core.state.refusals == {DropReason.UNKNOWN_SENDER: 1, DropReason.MALFORMED: 1}


def test_a_record_of_an_untrusted_domain_is_refused() -> None:
    core, stranger = rib(), node("x", domain=ELSEWHERE)
    (answer,) = responses(give(core, record(stranger).wire, stranger), stranger)
    assert answer.refused is DropReason.WRONG_DOMAIN
    assert len(core.state.endpoints) == 0


def test_endpoints_stay_within_the_domain_of_their_switch() -> None:
    core = rib()
    give(core, record().wire)
    give(core, record(FOREIGN).wire, FOREIGN)
    assert records_for(give(core, query(FOREIGN), FOREIGN), FOREIGN) == []
    assert records_for(give(core, query(TWO, (FOREIGN.name, 0)), TWO), TWO) == []
    assert records_for(give(core, record(sequence=2).wire), FOREIGN) == []


@pytest.mark.parametrize("asker", [FOREIGN_RIB, node("p", Role.PROXY)])
def test_only_switches_and_ribs_of_the_domain_ask(asker: Identity) -> None:
    core = rib()
    give(core, record().wire)
    assert give(core, query(asker), asker) == []
    assert core.state.refusals[DropReason.WRONG_DOMAIN] == 1


def test_a_flood_of_records_by_one_member_costs_no_signatures_beyond_its_rate_and_no_memory() -> None:
    core = rib()
    wires = [record(sequence=sequence).wire for sequence in range(1, 60)]
    answered = sum(len(give(core, wire)) for wire in wires)
    assert answered <= ENDPOINT_RECORDS_RATE.burst
    assert core.state.refusals[DropReason.QUOTA] >= len(wires) - ENDPOINT_RECORDS_RATE.burst
    assert len(core.state.endpoints) == 1
    assert responses(give(core, record(TWO).wire, TWO), TWO)[0].refused is None


def test_records_of_other_domains_do_not_displace_those_of_ones_own() -> None:
    endpoints = RibEndpoints(RIB, Policy(SCHOOL.root, [CLOUD.root]), lambda name: None, maximum=4)
    numbers = count()
    for domain, expected in ((CLOUD, 2), (SCHOOL, 4)):
        for _ in range(4):
            try:
                endpoints.receive_record(parse(record(node(f"s{next(numbers)}", domain=domain)).wire), at(0.0))
            except StatementError as error:
                assert error.reason is DropReason.QUOTA  # noqa: PT017
        assert len(endpoints) == expected


def test_a_revoked_switch_is_forgotten_at_once() -> None:
    core, switch = rib(), node("gone")
    give(core, record(switch).wire, switch)
    assert len(core.state.endpoints) == 1
    fingerprint = switch.member.fingerprint
    core.revoke(Revocation.make(SCHOOL.key, SCHOOL.root.subject, fingerprint, UNIX_S + 600), ONE.name, at(1.0))
    assert len(core.state.endpoints) == 0
    (answer,) = responses(give(core, record(switch, 2).wire, switch, 1.0), switch)
    assert answer.refused is DropReason.REVOKED


def test_a_record_goes_to_the_other_ribs_of_the_domain_and_no_further() -> None:
    one, two = rib(peers=(PEER.name,)), rib(PEER, peers=(RIB.name,))
    equalise(one, two)
    sent = [each for each in give(one, record().wire) if each.to == PEER.name]
    assert [each.kind for each in sent] == [Kind.RIB_REQUEST]
    out = give(two, sent[0].statement, RIB)
    assert [each for each in out if each.to == RIB.name] == []
    assert len(two.state.endpoints) == 1


def test_a_rib_that_has_just_started_fetches_what_its_peers_keep() -> None:
    old, new = rib(peers=(PEER.name,)), rib(PEER, peers=(RIB.name,))
    switches = [node(f"s{number}") for number in range(40)]
    for switch in switches:
        give(old, record(switch).wire, switch)
    give(old, record(FOREIGN).wire, FOREIGN)
    new.connected(at(0.0))
    assert len(equalise(old, new)) > 4
    assert len(new.state.endpoints) == len(switches)


def test_two_ribs_do_not_keep_a_record_alive_that_its_switch_does_not_renew() -> None:
    one, two = rib(peers=(PEER.name,)), rib(PEER, peers=(RIB.name,))
    give(one, record().wire)
    for now_s in range(2 * int(ENDPOINT.lease_s)):
        equalise(one, two, now_s=float(now_s))
        assert (len(one.state.endpoints), len(two.state.endpoints)) == (1, 1) or now_s >= ENDPOINT.lease_s - 2
    assert (len(one.state.endpoints), len(two.state.endpoints)) == (0, 0)


def test_records_from_a_rib_of_another_domain_are_refused() -> None:
    core = rib()
    by = FOREIGN_RIB
    items = (item_of(record().wire, 60.0),)
    give(core, SyncMessage(of=ENDPOINTS, items=items).to_wire(by.name, by.key, by.membership), by)
    give(core, RelayedStatement(record().wire, (), by.membership).to_wire(by.name, by.key), by)
    assert len(core.state.endpoints) == 0
    assert core.state.refusals == {DropReason.WRONG_DOMAIN: 1, DropReason.MALFORMED: 1}


def test_a_query_is_answered_although_there_are_too_many_watches() -> None:
    core = RibCore(RIB, Policy(SCHOOL.root, [CLOUD.root]), MemoryStore(), RibSettings(watches=1))
    wire = record().wire
    give(core, wire)
    known = tuple((Name(bytes([number]) * 32), 0) for number in range(1, 9))
    assert records_for(give(core, query(TWO, *known, (ONE.name, 0)), TWO), TWO) == [wire]
    assert core.state.refusals[DropReason.QUOTA] == 1
