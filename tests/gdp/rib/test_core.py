"""RIB: accepted statements, refused ones with their reason, responses, and watches."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gdp.control.rib_statements import AdvertiseAck, Query, RelayedStatement, Response
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.statements import StatementType, parse, sign
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, StoreError
from gdp.intervals import ADVERTISEMENT, NEGATIVE_LEASE_S
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.rib.outbox import OutgoingStatement
from gdp.rib.route import Route
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.sansio import Timestamps
from gdp.trust.advertisement import UnverifiedAdvertisement, Withdrawal
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from tests.gdp.trust.world import (
    CAMERA,
    CLOUD,
    DAY,
    GATEWAY,
    HOUR,
    LATER,
    NOW,
    ROBOT,
    SCHOOL,
    STRANGER,
    SWITCH,
    adcert,
    advertisement,
)
from tests.visited import visited

RIB = NodeKeys.generate(Role.RIB, "rib").join(SCHOOL, DAY)
UPPER = NodeKeys.generate(Role.RIB, "upper").join(CLOUD, DAY)
OTHER_SWITCH = NodeKeys.generate(Role.SWITCH, "nuc2").join(SCHOOL, DAY)
CLOUD_SWITCH = NodeKeys.generate(Role.SWITCH, "nuc4").join(CLOUD, DAY)
NAME = CAMERA.name
FILES_OF_A_STATEMENT = {"advertisement": 7, "withdrawal": 8}  # they only fall


def at(mono_s: float, unix_s: float = NOW) -> Timestamps:
    return Timestamps(mono_s, unix_s)


START = at(0.0)


def rib(upper: Name | None = None, **settings: object) -> RibCore:
    policy = Policy(SCHOOL.root, [CLOUD.root])
    of_node = RibSettings(upper=() if upper is None else (upper,))
    return RibCore(RIB, policy, MemoryStore(), replace(of_node, **settings))  # type: ignore[arg-type]


def relay(statement: bytes, by: Identity = SWITCH) -> bytes:
    return RelayedStatement(statement, (SCHOOL.root.domain,), by.membership).to_wire(by.name, by.key)


def tell(to: RibCore, statement: bytes, by: Identity = SWITCH, now: Timestamps = START) -> list[OutgoingStatement]:
    """Relay an advertisement or a withdrawal; return the statements that the RIB sends."""
    to.receive(relay(statement, by), by.name, now)
    return to.statements_to_send()


def ask(of: RibCore, by: Identity = SWITCH, watch_s: float = 0.0) -> list[OutgoingStatement]:
    of.receive(Query(NAME, watch_s).to_wire(by.name, by.key, by.membership), by.name, START)
    return of.statements_to_send()


def answers(letters: list[OutgoingStatement]) -> list[Response]:
    found = [parse(outgoing.statement) for outgoing in letters]
    return [Response.from_fields(each.fields) for each in found if each.type is StatementType.ANSWER]


def acks(letters: list[OutgoingStatement]) -> list[AdvertiseAck]:
    found = [parse(outgoing.statement) for outgoing in letters]
    return [AdvertiseAck.from_fields(each.fields) for each in found if each.type is StatementType.ADVERTISE_ACK]


def answer_from_upstream(
    to: RibCore, pending_advertisement: bytes, now: Timestamps = START, by: Identity = UPPER
) -> list[OutgoingStatement]:
    node = parse(pending_advertisement).signer if pending_advertisement else ROBOT.name
    gone = 0 if pending_advertisement else UnverifiedAdvertisement.from_statement(parse(advertisement())).sequence
    response = Response(
        name=NAME,
        advertiser=node,
        advertisement=pending_advertisement,
        domain=CLOUD.root.domain,
        transit=(CLOUD.root.domain,),
        lease_s=30.0,
        sequence=gone,
    )
    to.receive(response.to_wire(by.name, by.key, by.membership), by.name, now)
    return to.statements_to_send()


def negative_upstream(to: RibCore, now: Timestamps = START) -> list[OutgoingStatement]:
    response = Response(
        name=NAME, advertiser=NAME, advertisement=b"", domain=CLOUD.root.domain, transit=(), lease_s=2.0
    )
    to.receive(response.to_wire(UPPER.name, UPPER.key, UPPER.membership), UPPER.name, now)
    return to.statements_to_send()


def withdrawal(sequence: int, by: Identity = ROBOT, key: Identity | None = None) -> bytes:
    body = {"n": NAME, "right": Right.PUBLISH.value, "s": sequence}
    return sign(StatementType.WITHDRAW, body, by.name, (key or by).key)


def local_advertisement(sequence: int = 1) -> bytes:
    return UnverifiedAdvertisement(
        subject=CAMERA,
        right=Right.PUBLISH,
        rtcert=RtCert.make(ROBOT, SWITCH.name, DAY),
        sequence=sequence,
        incarnation=7,
        lease_ms=60_000,
        is_global=False,
        chain=(adcert(),),
    ).signed(ROBOT)


def foreign_advertisement(*, is_global: bool = True, sequence: int = 1) -> bytes:
    """Return an advertisement of the robot at a switch of the cloud's domain."""
    return UnverifiedAdvertisement(
        subject=CAMERA,
        right=Right.PUBLISH,
        rtcert=RtCert.make(ROBOT, CLOUD_SWITCH.name, DAY),
        sequence=sequence,
        incarnation=7,
        lease_ms=60_000,
        is_global=is_global,
        chain=(adcert(),),
    ).signed(ROBOT)


def altered(change: dict[str, object]) -> bytes:
    """Return the robot's advertisement with a changed body, signed again by the robot."""
    body = {**UnverifiedAdvertisement.from_statement(parse(advertisement())).to_fields(), **change}
    return sign(StatementType.ADVERTISE, body, ROBOT.name, ROBOT.key)


# -- accepted and refused advertisements


def test_a_good_advertisement_is_accepted_and_its_relay_informed() -> None:
    at_rib = rib()
    (ack,) = acks(tell(at_rib, advertisement(sequence=4)))
    assert (ack.name, ack.advertiser, ack.refused, ack.sequence) == (NAME, ROBOT.name, None, 4)
    assert (at_rib.names, at_rib.state.accepted, at_rib.state.refusals) == (1, 1, {})


FOREIGN_SWITCH_ADVERTISEMENT = advertisement(rtcert=RtCert.make(ROBOT, OTHER_SWITCH.name, DAY))
REFUSED = {
    "forged": (
        sign(StatementType.ADVERTISE, parse(advertisement()).fields, ROBOT.name, GATEWAY.key),
        DropReason.BAD_SIGNATURE,
    ),
    "wrong name hash": (altered({"name": bytes(NAME)[::-1]}), DropReason.WRONG_NAME),
    "not delegated": (advertisement(chain=[]), DropReason.NOT_DELEGATED),
    "delegated for something else": (advertisement(right=Right.SERVE), DropReason.NOT_DELEGATED),
    "another's RtCert": (advertisement(rtcert=RtCert.make(GATEWAY, SWITCH.name, DAY)), DropReason.NOT_DELEGATED),
    "no RtCert": (altered({"rt": b""}), DropReason.MALFORMED),
    "an RtCert for another switch": (FOREIGN_SWITCH_ADVERTISEMENT, DropReason.NOT_DELEGATED),
    "a lease too short": (altered({"lease": 10}), DropReason.LEASE_BOUNDS),
    "a lease too long": (altered({"lease": 3_600_001}), DropReason.LEASE_BOUNDS),
}


@pytest.mark.parametrize("why", REFUSED)
def test_an_advertisement_that_does_not_hold_is_refused_with_its_reason(why: str) -> None:
    wire, reason = REFUSED[why]
    at_rib = rib()
    reported = acks(tell(at_rib, wire))
    assert at_rib.state.refusals == {reason: 1}
    assert at_rib.names == 0
    assert {each.refused for each in reported} <= {reason}


@pytest.mark.parametrize("at_byte", range(0, 900, 31))
def test_an_altered_advertisement_is_refused(at_byte: int) -> None:
    at_rib, wire = rib(), bytearray(advertisement())
    wire[at_byte % len(wire)] ^= 0x20
    tell(at_rib, bytes(wire))
    assert at_rib.names == 0
    assert at_rib.state.refusals.total() == 1


def test_an_older_advertisement_played_back_is_stale_and_the_refusal_says_what_to_pass() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(sequence=9))
    (ack,) = acks(tell(at_rib, advertisement(sequence=8)))
    assert (ack.refused, ack.sequence) == (DropReason.STALE, 9)


def test_the_same_advertisement_again_is_no_news_and_no_harm() -> None:
    at_rib, wire = rib(), advertisement()
    tell(at_rib, wire)
    (ack,) = acks(tell(at_rib, wire))
    assert (ack.refused, at_rib.names) == (None, 1)


def test_a_rib_of_another_domain_cannot_draw_a_known_advertisement_to_itself() -> None:
    at_rib, wire = rib(), advertisement()
    tell(at_rib, wire)
    tell(at_rib, wire, UPPER)
    assert at_rib.state.refusals == {DropReason.STALE: 1}
    assert [each.domain for each in answers(ask(at_rib))] == [SCHOOL.root.domain]


def test_an_expired_delegation_is_refused() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(chain=[adcert(validity=HOUR)]), now=at(0.0, LATER))
    assert at_rib.state.refusals == {DropReason.EXPIRED: 1}


def test_an_advertisement_of_a_stranger_is_refused() -> None:
    policy = Policy(SCHOOL.root)
    at_rib = RibCore(RIB, policy, MemoryStore(), RibSettings())
    tell(at_rib, advertisement(STRANGER))
    assert at_rib.state.refusals == {DropReason.WRONG_DOMAIN: 1}


def test_a_proxy_relays_nothing() -> None:
    at_rib = rib()
    assert tell(at_rib, advertisement(), ROBOT) == []
    assert at_rib.state.refusals == {DropReason.WRONG_DOMAIN: 1}


def test_a_switch_of_a_trusted_domain_relays_global_names_which_stand_in_its_own_domain() -> None:
    at_rib = rib()
    (ack,) = acks(tell(at_rib, foreign_advertisement(), CLOUD_SWITCH))
    assert ack.refused is None
    (answer,) = answers(ask(at_rib))
    assert (answer.domain, answer.transit) == (CLOUD.root.domain, (SCHOOL.root.domain,))
    assert [each.domain for each in answers(ask(at_rib, CLOUD_SWITCH))] == [CLOUD.root.domain]


def test_a_local_name_of_another_domain_is_refused() -> None:
    at_rib = rib()
    (ack,) = acks(tell(at_rib, foreign_advertisement(is_global=False), CLOUD_SWITCH))
    assert (ack.refused, at_rib.names) == (DropReason.WRONG_DOMAIN, 0)


def test_a_switch_of_a_domain_that_is_not_trusted_relays_nothing() -> None:
    at_rib = RibCore(RIB, Policy(SCHOOL.root), MemoryStore(), RibSettings())
    assert tell(at_rib, foreign_advertisement(), CLOUD_SWITCH) == []
    assert at_rib.state.refusals == {DropReason.WRONG_DOMAIN: 1}


def test_a_relay_under_anothers_name_is_refused() -> None:
    at_rib = rib()
    at_rib.receive(relay(advertisement()), OTHER_SWITCH.name, at(0.0))
    assert (at_rib.statements_to_send(), at_rib.state.refusals) == ([], {DropReason.UNKNOWN_SENDER: 1})


def test_a_relay_under_anothers_certificate_is_refused() -> None:
    at_rib = rib()
    wire = RelayedStatement(advertisement(), (), OTHER_SWITCH.membership).to_wire(SWITCH.name, SWITCH.key)
    at_rib.receive(wire, SWITCH.name, at(0.0))
    assert (at_rib.statements_to_send(), at_rib.state.refusals) == ([], {DropReason.BAD_CERTIFICATE: 1})


def test_a_relay_signed_by_another_key_gets_no_answer_and_leaves_nothing() -> None:
    at_rib = rib()
    wire = RelayedStatement(advertisement(), (), SWITCH.membership).to_wire(SWITCH.name, ROBOT.key)
    at_rib.receive(wire, SWITCH.name, at(0.0))
    assert (at_rib.statements_to_send(), at_rib.names, at_rib.state.refusals) == ([], 0, {DropReason.BAD_SIGNATURE: 1})


def test_a_sender_has_a_quota_of_names() -> None:
    at_rib = rib(names_per_sender=1)
    tell(at_rib, advertisement())
    own = Subject.of(Metadata({"kind": "topic", "name": "/own"}), ROBOT.key.public.compressed)
    (ack,) = acks(tell(at_rib, advertisement(subject=own, chain=[])))
    assert ack.refused is DropReason.QUOTA
    assert acks(tell(at_rib, advertisement(sequence=2)))[0].refused is None


def test_advertising_and_withdrawing_in_turn_does_not_pass_the_quota() -> None:
    at_rib = rib(names_per_sender=5)
    for number in range(10):
        own = Subject.of(Metadata({"kind": "topic", "name": f"/own{number}"}), ROBOT.key.public.compressed)
        tell(at_rib, advertisement(subject=own, chain=[]))
        tell(at_rib, Withdrawal(own.name, Right.PUBLISH, 2).to_wire(ROBOT.name, ROBOT.key))
    assert at_rib.state.refusals == {DropReason.QUOTA: 7, DropReason.STALE: 7}  # a node may have as many as are free


def test_a_node_leaves_capacity_for_the_other_nodes_of_its_switch() -> None:
    at_rib = rib(names_per_sender=30)
    for number in range(40):
        own = Subject.of(Metadata({"kind": "topic", "name": f"/own{number}"}), ROBOT.key.public.compressed)
        tell(at_rib, advertisement(subject=own, chain=[]))
    assert at_rib.names == 15
    rtcert = RtCert.make(GATEWAY, SWITCH.name, DAY)
    others = Subject.of(Metadata({"kind": "topic", "name": "/others"}), GATEWAY.key.public.compressed)
    assert acks(tell(at_rib, advertisement(node=GATEWAY, subject=others, chain=[], rtcert=rtcert)))[0].refused is None


def test_an_operator_may_bound_leases_further() -> None:
    at_rib = rib(lease_max_s=30.0)
    (ack,) = acks(tell(at_rib, advertisement(lease_s=60.0)))
    assert ack.refused is DropReason.LEASE_BOUNDS


@pytest.mark.parametrize("wire", [b"", b"rubbish", advertisement(), bytes(20_000)])
def test_what_is_no_statement_for_a_rib_is_malformed(wire: bytes) -> None:
    at_rib = rib()
    at_rib.receive(wire, ROBOT.name, at(0.0))
    assert (at_rib.statements_to_send(), at_rib.state.refusals) == ([], {DropReason.MALFORMED: 1})


def test_an_ack_is_shorter_than_the_relay_that_it_answers() -> None:
    at_rib = rib()
    for wire in (advertisement(), advertisement(chain=[]), REFUSED["forged"][0]):
        sent = relay(wire)
        at_rib.receive(sent, SWITCH.name, at(0.0))
        assert all(len(outgoing.statement) < len(sent) for outgoing in at_rib.statements_to_send())


# -- withdrawals and leases


def test_a_withdrawn_name_gets_a_negative_response() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(sequence=3))
    assert acks(tell(at_rib, withdrawal(4)))[0].refused is None
    (answer,) = answers(ask(at_rib))
    assert (answer.is_negative, answer.lease_s) == (True, NEGATIVE_LEASE_S)


def test_a_withdrawn_advertisement_played_back_stays_withdrawn() -> None:
    at_rib, wire = rib(), advertisement(sequence=3)
    tell(at_rib, wire)
    tell(at_rib, withdrawal(4))
    tell(at_rib, wire)
    assert (at_rib.names, at_rib.state.refusals) == (0, {DropReason.STALE: 1})


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        (withdrawal(2), DropReason.STALE),
        (withdrawal(4, key=GATEWAY), DropReason.BAD_SIGNATURE),
        (withdrawal(4, by=GATEWAY), DropReason.STALE),
    ],
    ids=["old", "forged", "another's"],
)
def test_a_withdrawal_that_does_not_hold_takes_nothing_away(wire: bytes, reason: DropReason) -> None:
    at_rib = rib()
    tell(at_rib, advertisement(sequence=3))
    tell(at_rib, wire)
    assert (at_rib.names, at_rib.state.refusals) == (1, {reason: 1})


def test_a_lease_that_is_not_renewed_ends() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(lease_s=60.0))
    assert at_rib.get_timer() == 60.0
    at_rib.handle_timer(at(60.0))
    assert at_rib.names == 0
    assert at_rib.get_timer() is None


def test_a_lease_that_is_renewed_goes_on() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(lease_s=60.0))
    tell(at_rib, advertisement(lease_s=60.0, sequence=2), now=at(50.0))
    at_rib.handle_timer(at(60.0))
    assert at_rib.names == 1


def test_no_lease_outlasts_its_evidence() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(chain=[adcert(validity=HOUR)], lease_s=3_600.0), now=at(0.0, NOW + 3_590))
    assert at_rib.get_timer() == pytest.approx(10.0)


# -- queries and watches


def test_an_answer_carries_the_advertisement_as_it_was_signed() -> None:
    at_rib, wire = rib(), advertisement()
    tell(at_rib, wire)
    (answer,) = answers(ask(at_rib))
    assert (answer.advertisement, answer.advertiser, answer.domain) == (wire, ROBOT.name, SCHOOL.root.domain)


def test_a_question_signed_by_another_key_gets_no_answer() -> None:
    at_rib = rib()
    tell(at_rib, advertisement())
    at_rib.receive(Query(NAME, 9.0).to_wire(SWITCH.name, ROBOT.key, SWITCH.membership), SWITCH.name, at(0.0))
    assert (at_rib.statements_to_send(), len(at_rib.state.outbox.watches)) == ([], 0)


def test_a_switch_of_another_domain_hears_of_global_names_only() -> None:
    at_rib = rib()
    tell(at_rib, local_advertisement())
    assert [each.is_negative for each in answers(ask(at_rib, CLOUD_SWITCH, watch_s=20.0))] == [True]
    assert [outgoing.to for outgoing in tell(at_rib, local_advertisement(2))] == [SWITCH.name]
    assert CLOUD_SWITCH.name in [
        outgoing.to for outgoing in tell(at_rib, advertisement(sequence=3)) if answers([outgoing])
    ]


def test_a_watcher_is_informed_of_new_and_of_removed_routes() -> None:
    at_rib = rib()
    assert answers(ask(at_rib, watch_s=20.0))[0].is_negative
    found = answers(tell(at_rib, advertisement(), OTHER_SWITCH)) or answers(tell(at_rib, advertisement()))
    assert [each.advertisement != b"" for each in found] == [True]
    (gone,) = answers(tell(at_rib, withdrawal(2)))
    assert (gone.advertiser, gone.advertisement) == (ROBOT.name, b"")


def test_a_watcher_is_informed_when_a_lease_ends() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(lease_s=5.0))
    ask(at_rib, watch_s=20.0)
    at_rib.handle_timer(at(5.0))
    assert [each.advertisement for each in answers(at_rib.statements_to_send())] == [b""]


def test_a_watch_that_ended_gets_no_news() -> None:
    at_rib = rib()
    ask(at_rib, watch_s=5.0)
    assert answers(tell(at_rib, advertisement(), now=at(6.0))) == []
    at_rib.handle_timer(at(6.0))
    assert len(at_rib.state.outbox.watches) == 0


def test_too_many_watches_are_counted_and_answered_all_the_same() -> None:
    at_rib = rib(watches=0)
    tell(at_rib, advertisement())
    assert len(answers(ask(at_rib, watch_s=20.0))) == 1
    assert (len(at_rib.state.outbox.watches), at_rib.state.refusals) == (0, {DropReason.QUOTA: 1})


def test_a_switch_that_loses_a_name_to_another_is_informed() -> None:
    at_rib = rib()
    tell(at_rib, advertisement())
    moved = advertisement(rtcert=RtCert.make(ROBOT, OTHER_SWITCH.name, DAY), sequence=2)
    letters = tell(at_rib, moved, OTHER_SWITCH)
    assert [outgoing.to for outgoing in letters if answers([outgoing])] == [SWITCH.name]


def test_a_switch_that_relays_an_old_advertisement_of_a_node_that_moved_hears_where_it_is() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(rtcert=RtCert.make(ROBOT, OTHER_SWITCH.name, DAY), sequence=2), OTHER_SWITCH)
    letters = tell(at_rib, advertisement())
    assert [each.refused for each in acks(letters)] == [DropReason.STALE]
    assert [parse(each.advertisement).fields["seq"] for each in answers(letters)] == [2]


def test_a_switch_whose_node_is_withdrawn_elsewhere_is_informed() -> None:
    at_rib = rib()
    tell(at_rib, advertisement())
    letters = tell(at_rib, withdrawal(2), OTHER_SWITCH)
    assert [(outgoing.to, answers([outgoing])[0].advertisement) for outgoing in letters if answers([outgoing])] == [
        (SWITCH.name, b"")
    ]


# -- tiers


def test_a_switch_hears_from_above_that_its_node_has_moved_to_another_domain() -> None:
    at_rib = rib(UPPER.name)
    tell(at_rib, advertisement(sequence=1))
    letters = answer_from_upstream(at_rib, advertisement(sequence=2))
    assert [(outgoing.to, answers([outgoing])[0].domain) for outgoing in letters] == [(SWITCH.name, CLOUD.root.domain)]


def test_a_global_name_climbs() -> None:
    letters = tell(rib(UPPER.name), advertisement())
    passed = [
        RelayedStatement.from_fields(parse(each.statement).fields).statement
        for each in letters
        if each.to == UPPER.name
    ]
    assert [parse(each).signer for each in passed] == [ROBOT.name]


def test_a_local_name_stays() -> None:
    letters = tell(rib(UPPER.name), local_advertisement())
    assert [outgoing.to for outgoing in letters] == [SWITCH.name]


def test_a_local_name_is_announced_to_the_own_domain_only() -> None:
    at_rib = rib()
    tell(at_rib, local_advertisement())
    assert [each.is_negative for each in answers(ask(at_rib))] == [False]
    assert [each.is_negative for each in answers(ask(at_rib, UPPER))] == [True]


def test_a_withdrawal_of_a_global_name_climbs() -> None:
    at_rib = rib(UPPER.name)
    tell(at_rib, advertisement())
    assert UPPER.name in [outgoing.to for outgoing in tell(at_rib, withdrawal(2))]


def test_an_unknown_name_is_asked_for_above_and_answered_when_that_answers() -> None:
    at_rib = rib(UPPER.name)
    asked = ask(at_rib)
    assert [(outgoing.to, parse(outgoing.statement).type) for outgoing in asked] == [(UPPER.name, StatementType.QUERY)]
    letters = answer_from_upstream(at_rib, advertisement())
    assert [outgoing.to for outgoing in letters] == [SWITCH.name]
    assert answers(letters)[0].domain == CLOUD.root.domain


def test_many_askers_cost_one_question_above_and_all_are_answered() -> None:
    at_rib = rib(UPPER.name)
    assert len(ask(at_rib)) == 1
    assert ask(at_rib, OTHER_SWITCH) == []
    assert {outgoing.to for outgoing in negative_upstream(at_rib)} == {SWITCH.name, OTHER_SWITCH.name}


def test_an_asker_hears_of_every_advertiser_that_the_tier_above_knows() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib)
    first = answer_from_upstream(at_rib, advertisement())
    second = answer_from_upstream(at_rib, advertisement(GATEWAY, chain=[adcert(GATEWAY)]))
    assert [outgoing.to for outgoing in (*first, *second)] == [SWITCH.name, SWITCH.name]


def test_a_tier_above_that_is_silent_is_asked_again_and_then_the_answer_is_unknown() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib)
    reported: list[Response] = []
    again = 0
    for _ in range(10):
        due_s = at_rib.get_timer()
        if due_s is None:
            break
        at_rib.handle_timer(at(due_s))
        letters = at_rib.statements_to_send()
        again += sum(outgoing.to == UPPER.name for outgoing in letters)
        reported += answers([outgoing for outgoing in letters if outgoing.to == SWITCH.name])
        following = at_rib.get_timer()
        assert following is None or following > due_s
    assert [(each.is_negative, each.is_unknown) for each in reported] == [(False, True)]
    assert again >= 3
    assert at_rib.get_timer() is None


def unknown_upstream(to: RibCore, now: Timestamps = START) -> list[OutgoingStatement]:
    response = Response(
        name=NAME, advertiser=NAME, advertisement=b"", domain=CLOUD.root.domain, transit=(), lease_s=0.0
    )
    to.receive(response.to_wire(UPPER.name, UPPER.key, UPPER.membership), UPPER.name, now)
    return to.statements_to_send()


def test_what_the_tier_above_does_not_know_is_unknown_here_too() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib)
    assert [each.is_unknown for each in answers(unknown_upstream(at_rib))] == [True]
    assert (at_rib.state.outbox.negative_answers, at_rib.state.outbox.unknown_answers) == (0, 1)
    assert [outgoing.to for outgoing in ask(at_rib)] == [UPPER.name], "the next query is forwarded again"


def test_a_route_that_the_tier_above_does_not_know_any_more_outlives_its_lease() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib, watch_s=3_600.0)
    answer_from_upstream(at_rib, advertisement())
    for second in range(1, 100):
        at_rib.handle_timer(at(second))
        for outgoing in at_rib.statements_to_send():
            if outgoing.to == UPPER.name:
                assert not any(not each.advertisement for each in answers(unknown_upstream(at_rib, at(second))))
    assert at_rib.names == 1


LOWER = NodeKeys.generate(Role.RIB, "lower").join(CLOUD, DAY)


def sign_of_life(to: RibCore, now_s: float) -> None:
    """Let the RIB below answer a probe."""
    response = Response(
        name=LOWER.name, advertiser=LOWER.name, advertisement=b"", domain=CLOUD.root.domain, transit=(), lease_s=0.5
    )
    to.receive(response.to_wire(LOWER.name, LOWER.key, LOWER.membership), LOWER.name, at(now_s))


@pytest.mark.parametrize("lives", [True, False])
def test_a_lease_that_a_rib_below_does_not_renew_ends_only_if_that_rib_lives(lives: bool) -> None:
    at_rib = rib()
    tell(at_rib, advertisement(lease_s=10.0), by=LOWER)
    ask(at_rib, watch_s=3_600.0)
    gone: list[Response] = []
    for second in range(1, 60):
        at_rib.handle_timer(at(second))
        letters = at_rib.statements_to_send()
        gone += [each for each in answers(letters) if not each.advertisement]
        if lives and any(outgoing.to == LOWER.name for outgoing in letters):
            sign_of_life(at_rib, second + 0.1)
    assert (at_rib.names, bool(gone)) == ((0, True) if lives else (1, False))


def test_a_rib_below_that_is_back_has_half_a_lease_to_relay_again_what_was_kept() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(lease_s=10.0), by=LOWER)
    ends_s = 0.0
    for second in range(1, 80):
        at_rib.handle_timer(at(second))
        probed = any(outgoing.to == LOWER.name for outgoing in at_rib.statements_to_send())
        if second >= 40 and probed:
            sign_of_life(at_rib, second + 0.1)
        ends_s = ends_s or (second if at_rib.names == 0 else 0.0)
    assert ends_s >= 40 + ADVERTISEMENT.lease_s / 2


def test_no_proof_of_an_advertiser_outlives_its_validity_because_a_rib_is_silent() -> None:
    at_rib = rib()
    tell(at_rib, advertisement(lease_s=10.0), by=LOWER)
    at_rib.handle_timer(at(11.0, NOW + 40 * 86_400.0))
    assert at_rib.names == 0


def test_a_name_gone_upstream_is_gone_here_and_watchers_are_informed() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib, watch_s=20.0)
    answer_from_upstream(at_rib, advertisement())
    letters = answer_from_upstream(at_rib, b"")
    assert [(outgoing.to, answers([outgoing])[0].advertisement) for outgoing in letters] == [(SWITCH.name, b"")]
    assert at_rib.names == 0


def test_news_that_another_is_gone_answers_no_open_question() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib)
    assert answer_from_upstream(at_rib, b"") == []
    assert [each.is_negative for each in answers(negative_upstream(at_rib))] == [True]


def test_an_answer_from_no_tier_above_is_refused() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib)
    other = NodeKeys.generate(Role.RIB, "other").join(CLOUD, DAY)
    assert answer_from_upstream(at_rib, advertisement(), by=other) == []
    assert at_rib.state.refusals == {DropReason.WRONG_DOMAIN: 1}


def test_the_tier_above_cannot_forge_an_advertisement_either() -> None:
    at_rib = rib(UPPER.name)
    ask(at_rib)
    assert answer_from_upstream(at_rib, REFUSED["forged"][0]) == []
    assert (at_rib.names, at_rib.state.refusals) == (0, {DropReason.BAD_SIGNATURE: 1})


def test_a_tier_above_that_is_behind_does_not_undo_what_is_newer_here() -> None:
    at_rib = rib(UPPER.name)
    tell(at_rib, advertisement(sequence=5))
    answer_from_upstream(at_rib, advertisement(sequence=4))
    assert at_rib.state.refusals == {DropReason.STALE: 1}
    assert answers(ask(at_rib))[0].domain == SCHOOL.root.domain


class AwayStore(MemoryStore):
    """A shared store that may be away."""

    is_away = False

    def routes(self, name: Name) -> list[Route]:
        if self.is_away:
            raise StoreError("away")
        return super().routes(name)


def test_a_rib_outlives_a_shared_store_and_a_tier_above_that_are_both_away() -> None:
    store = AwayStore()
    policy = Policy(SCHOOL.root, [CLOUD.root])
    at_rib = RibCore(RIB, policy, store, RibSettings(upper=(UPPER.name,)))
    ask(at_rib, watch_s=100.0)
    answer_from_upstream(at_rib, advertisement())
    store.is_away = True
    for step in range(30):
        at_rib.handle_timer(at(step / 2))
        at_rib.statements_to_send()
    assert at_rib.state.refusals[DropReason.UNAVAILABLE] > 0
    store.is_away = False
    assert store.get(NAME, ROBOT.name) is not None


@pytest.mark.parametrize("kind", FILES_OF_A_STATEMENT)
def test_a_relayed_statement_visits_few_files(kind: str) -> None:
    at_rib, seen = rib(upper=UPPER.name), set[str]()
    ask(at_rib, OTHER_SWITCH, watch_s=60.0)
    statement = advertisement()
    if kind == "withdrawal":
        tell(at_rib, statement)
        statement = withdrawal(2)
    visited("rib", seen, lambda: at_rib.receive(relay(statement), SWITCH.name, START))
    assert {each.to for each in at_rib.statements_to_send()} == {SWITCH.name, OTHER_SWITCH.name, UPPER.name}
    assert len(seen) <= FILES_OF_A_STATEMENT[kind], sorted(seen)
