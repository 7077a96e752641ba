"""Endpoint exchange: when a switch publishes, when it asks, and which records it believes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gdp.control.endpoints import (
    ENDPOINT_NAMES_MAX,
    ENDPOINTS,
    Candidate,
    CandidateType,
    Endpoint,
    EndpointRecord,
    item_of,
)
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType, parse
from gdp.crypto.tunnel_key import TunnelKey
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage
from gdp.exchange.sync_set import line_of
from gdp.intervals import ENDPOINT
from gdp.names import Name
from gdp.switch.endpoint_exchange import EndpointExchange, Refusal
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from tests.gdp.control.members import CLOUD, SCHOOL, UNIX_S, at, node

ME, PEER, FOREIGN = node("nuc1"), node("nuc2"), node("nuc4", domain=CLOUD)


def record(of: Identity = ME, sequence: int = 1, until_unix_s: int = UNIX_S + 6_000) -> EndpointRecord:
    candidates = (Candidate(0, CandidateType.REFLEXIVE, Endpoint("192.0.2.1", sequence)),)
    keys = (TunnelKey.derive(of.kem).public,)
    return EndpointRecord.make(of, keys, candidates, sequence=sequence, until_unix_s=until_unix_s)


def altered(wire: bytes) -> bytes:
    """Return a statement with another signature."""
    return wire[:-1] + bytes([wire[-1] ^ 1])


def exchange(*wanted: Identity) -> EndpointExchange:
    """Return an exchange that wants the records of these switches and has asked for them."""
    made = EndpointExchange(ME, Policy(SCHOOL.root, [CLOUD.root]))
    made.want([each.name for each in wanted], 0.0)
    made.statements_to_send(0.0)
    return made


def sent(of: EndpointExchange, until_s: float) -> list[tuple[float, StatementType]]:
    """Return what is sent until a second, with its time."""
    found: list[tuple[float, StatementType]] = []
    while (due_s := of.get_timer()) is not None and due_s <= until_s:
        now_s = max(due_s, found[-1][0] if found else 0.0)
        found += [(now_s, parse(wire).type) for wire in of.statements_to_send(now_s)]
    return found


def kept(sequence: int, refused: DropReason | None = None) -> SyncMessage:
    """Return a response of a RIB that keeps this record of ours; 0: none."""
    line = line_of(ME.name, sequence) if sequence else b""
    return SyncMessage(of=ENDPOINTS, lacking=((ME.name, line),), refused=refused)


def learn(into: EndpointExchange, *wires: bytes) -> None:
    into.receive(replace(kept(0), items=tuple(item_of(wire, 60.0) for wire in wires)), at(0.0))


def test_a_record_is_sent_at_once_and_again_until_the_rib_keeps_it() -> None:
    made = exchange()
    made.set_own(record())
    times = [now_s for now_s, _ in sent(made, 20.0)]
    assert times[:4] == pytest.approx([0.0, 0.3, 0.9, 2.1])
    made.receive(kept(1), at(20.0))
    assert made.get_timer() == pytest.approx(20.0 + ENDPOINT.lease_s / 3)


def test_a_record_that_the_rib_has_lost_is_sent_again_at_once() -> None:
    made = exchange()
    made.set_own(record())
    made.statements_to_send(0.0)
    made.receive(kept(1), at(0.1))
    made.receive(kept(0), at(1.0))
    assert made.get_timer() == 1.0


def test_another_rib_receives_record_and_query_at_once() -> None:
    made = exchange(PEER)
    made.set_own(record())
    made.statements_to_send(0.0)
    made.receive(kept(1), at(0.1))
    made.rib_changed(1.0)
    types = [parse(wire).type for wire in made.statements_to_send(1.0)]
    assert sorted(types, key=str) == [StatementType.ENDPOINTS, StatementType.SYNC]


def test_a_refusal_is_kept_for_the_operator_until_the_record_is_accepted() -> None:
    made = exchange()
    made.set_own(record(sequence=3))
    made.statements_to_send(0.0)
    made.receive(kept(9, DropReason.STALE), at(0.1))
    assert made.refusal == Refusal(DropReason.STALE, 9)
    made.set_own(record(sequence=10))
    assert made.refusal is None


def test_a_record_that_is_not_newer_is_not_published() -> None:
    made = exchange()
    made.set_own(record(sequence=3))
    with pytest.raises(StatementError):
        made.set_own(record(sequence=3))


def test_nothing_is_sent_where_nothing_is_published_or_wanted() -> None:
    assert exchange().get_timer() is None


def test_a_query_names_what_is_known_already() -> None:
    made = exchange(PEER)
    learn(made, record(PEER, 4).wire)
    made.rib_changed(1.0)
    (wire,) = made.statements_to_send(1.0)
    assert SyncMessage.from_fields(parse(wire).fields).lacking == ((PEER.name, line_of(PEER.name, 4)),)


def test_a_query_is_repeated_often_until_answered_and_then_seldom() -> None:
    made = exchange(PEER)
    assert made.get_timer() == pytest.approx(0.3)
    learn(made)
    assert made.get_timer() == pytest.approx(5.0)


def test_a_switch_that_is_newly_wanted_is_asked_for_at_once() -> None:
    made = exchange(PEER)
    learn(made)
    made.want([PEER.name, FOREIGN.name], 1.0)
    assert made.get_timer() == 1.0
    assert len(made.statements_to_send(1.0)) == 1


def test_a_query_is_bounded() -> None:
    made = exchange()
    made.want([Name(bytes([1, number]) * 16) for number in range(200)], 0.0)
    (wire,) = made.statements_to_send(0.0)
    assert len(SyncMessage.from_fields(parse(wire).fields).lacking) == ENDPOINT_NAMES_MAX


def test_a_record_is_learnt_and_a_newer_one_replaces_it() -> None:
    made = exchange(PEER)
    for sequence in (1, 3, 2):
        learn(made, record(PEER, sequence).wire)
    assert made.records(at(0.0))[PEER.name].sequence == 3


def test_a_record_that_is_not_wanted_is_not_kept() -> None:
    made = exchange()
    learn(made, record(PEER).wire)
    assert made.records(at(0.0)) == {}


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        (record(FOREIGN).wire, DropReason.WRONG_DOMAIN),
        (record(node("p", Role.PROXY)).wire, DropReason.WRONG_DOMAIN),
        (altered(record(PEER).wire), DropReason.BAD_SIGNATURE),
        (record(PEER, until_unix_s=UNIX_S - 1).wire, DropReason.EXPIRED),
    ],
)
def test_a_record_that_does_not_verify_is_refused_and_the_others_count(wire: bytes, reason: DropReason) -> None:
    other = node("nuc3")
    made = exchange(PEER, FOREIGN, other)
    with pytest.raises(StatementError) as refused:
        learn(made, wire, record(other).wire)
    assert refused.value.reason is reason
    assert made.records(at(0.0)).keys() == {other.name}


def test_a_record_that_becomes_void_is_used_no_more() -> None:
    made = exchange(PEER)
    learn(made, record(PEER, until_unix_s=UNIX_S + 5).wire)
    assert made.records(at(5.0, UNIX_S + 5.0)).keys() == {PEER.name}
    assert made.records(at(6.0, UNIX_S + 6.0)) == {}


def test_a_record_of_a_revoked_switch_is_used_no_more() -> None:
    policy = Policy(SCHOOL.root, [CLOUD.root])
    made = EndpointExchange(ME, policy)
    made.want([PEER.name], 0.0)
    learn(made, record(PEER).wire)
    wire = Revocation.make(SCHOOL.key, SCHOOL.root.subject, PEER.member.fingerprint, UNIX_S + 600)
    policy.revoked.receive_revocation(parse(wire), ME.name, at(0.0), lambda _: True)
    assert made.records(at(0.0)) == {}
