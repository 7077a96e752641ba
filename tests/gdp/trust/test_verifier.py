"""Verification of advertisements: accepted ones, and reasons for the refusal of others."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.statements import StatementType, parse, sign
from gdp.crypto.subject import Subject
from gdp.crypto.validity import VALIDITY
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from gdp.trust.verifier import AdvertisementVerifier
from tests.gdp.trust.world import (
    CAMERA,
    CLOUD,
    DAY,
    GATEWAY,
    HOUR,
    LAB,
    LATER,
    NOW,
    ROBOT,
    SCHOOL,
    STRANGER,
    SWITCH,
    adcert,
    advertisement,
    verifier,
)

GOOD = advertisement()
UNTIL = DAY.not_after_unix_s


def refusal(wire: bytes, at: AdvertisementVerifier | None = None, unix_s: float = NOW) -> DropReason:
    with pytest.raises(StatementError) as caught:
        (at or verifier()).verify(wire, unix_s)
    return caught.value.reason


def forged(change: Callable[[dict[str, object]], object], signer: Name = ROBOT.name) -> bytes:
    """Return the good advertisement with a changed body, signed again by the robot."""
    body = UnverifiedAdvertisement.from_statement(parse(GOOD)).to_fields()
    change(body)
    return sign(StatementType.ADVERTISE, body, signer, ROBOT.key)


def test_a_good_advertisement_says_what_it_said() -> None:
    found = verifier().verify(GOOD, NOW)
    assert (found.name, found.node, found.switch, found.domain) == (
        CAMERA.name,
        ROBOT.name,
        SWITCH.name,
        SCHOOL.root.domain,
    )
    assert (found.right, found.sequence, found.incarnation) == (Right.PUBLISH, 1, 7)
    assert (found.lease_s, found.is_global, found.wire) == (60.0, True, GOOD)


def test_an_advertisement_states_over_how_many_paths_its_frames_are_to_travel() -> None:
    assert verifier().verify(GOOD, NOW).paths == 1
    assert verifier().verify(forged(lambda body: body.update(paths=2)), NOW).paths == 2


@pytest.mark.parametrize("paths", [0, 4, "2", True])
def test_another_number_of_paths_is_malformed(paths: object) -> None:
    assert refusal(forged(lambda body: body.update(paths=paths))) is DropReason.MALFORMED


def test_an_advertisement_is_accepted_again_from_its_own_bytes() -> None:
    at = verifier()
    assert at.verify(at.verify(GOOD, NOW).wire, NOW) == at.verify(GOOD, NOW)


@pytest.mark.parametrize("right", [Right.PUBLISH, Right.SERVE, Right.READ])
def test_an_owner_needs_no_delegation_for_its_own_name(right: Right) -> None:
    own = Subject.of(Metadata({"kind": "topic", "name": "/own"}), ROBOT.key.public.compressed)
    assert verifier().verify(advertisement(right=right, subject=own, chain=[]), NOW).name == own.name


def test_a_node_attaches_under_its_own_name() -> None:
    assert verifier().verify(advertisement(right=Right.ATTACH, subject=ROBOT.subject, chain=[]), NOW).name == ROBOT.name


def test_a_node_does_not_attach_under_another_name_of_its_own() -> None:
    own = Subject.of(Metadata({"kind": "topic", "name": "/own"}), ROBOT.key.public.compressed)
    assert refusal(advertisement(right=Right.ATTACH, subject=own, chain=[])) is DropReason.NOT_DELEGATED


def test_no_node_attaches_under_a_delegated_name() -> None:
    assert refusal(advertisement(right=Right.ATTACH)) is DropReason.NOT_DELEGATED


def test_an_unowned_name_is_open_only_where_the_domain_says_so() -> None:
    wire = advertisement(subject=Subject.of(Metadata({"kind": "topic"})), chain=[])
    assert refusal(wire) is DropReason.NOT_DELEGATED
    assert verifier(allow_unowned=True).verify(wire, NOW).node == ROBOT.name


def test_an_unowned_name_cannot_be_delegated() -> None:
    subject = Subject.of(Metadata({"kind": "topic"}))
    wire = advertisement(subject=subject, chain=[adcert(subject=subject)])
    assert refusal(wire, verifier(allow_unowned=True)) is DropReason.MALFORMED


def test_a_name_without_a_delegation_is_refused() -> None:
    assert refusal(advertisement(chain=[])) is DropReason.NOT_DELEGATED


def test_a_right_that_was_not_given_is_refused() -> None:
    assert refusal(advertisement(right=Right.READ)) is DropReason.NOT_DELEGATED


def test_a_delegation_to_another_node_is_refused() -> None:
    assert refusal(advertisement(chain=[adcert(GATEWAY)])) is DropReason.NOT_DELEGATED


def test_a_delegation_of_another_name_is_refused() -> None:
    other = LAB.subject(Metadata({"kind": "topic", "name": "/other"}))
    assert refusal(advertisement(chain=[adcert(subject=other)])) is DropReason.NOT_DELEGATED


def test_a_delegation_by_another_key_is_refused() -> None:
    assert refusal(advertisement(chain=[adcert(key=SigningKey.generate())])) is DropReason.BAD_SIGNATURE


def test_a_delegation_that_has_run_out_is_refused() -> None:
    assert refusal(advertisement(chain=[adcert(validity=HOUR)]), unix_s=LATER) is DropReason.EXPIRED


def test_a_gateway_that_may_delegate_does() -> None:
    chain = [adcert(GATEWAY, may_delegate=True), adcert(issuer=GATEWAY)]
    assert len(verifier().verify(advertisement(chain=chain), NOW).chain.links) == 2


def test_a_gateway_that_may_not_delegate_does_not() -> None:
    assert refusal(advertisement(chain=[adcert(GATEWAY), adcert(issuer=GATEWAY)])) is DropReason.NOT_DELEGATED


def test_a_gateway_cannot_give_more_than_it_has() -> None:
    chain = [adcert(GATEWAY, may_delegate=True), adcert(issuer=GATEWAY, rights=[Right.READ])]
    assert refusal(advertisement(right=Right.READ, chain=chain)) is DropReason.NOT_DELEGATED


def test_a_chain_with_a_link_missing_is_refused() -> None:
    assert refusal(advertisement(chain=[adcert(issuer=GATEWAY)])) is DropReason.BAD_SIGNATURE


def test_links_of_two_chains_do_not_join() -> None:
    other = AdCert.make(GATEWAY.key, CAMERA.name, CAMERA, ROBOT.subject, [Right.PUBLISH], DAY)
    assert refusal(advertisement(chain=[adcert(GATEWAY, may_delegate=True), other])) is DropReason.NOT_DELEGATED


def test_a_chain_longer_than_allowed_is_refused() -> None:
    links = [adcert(GATEWAY, may_delegate=True)]
    links += [adcert(GATEWAY, issuer=GATEWAY, may_delegate=True)] * 4
    assert refusal(advertisement(chain=links)) is DropReason.MALFORMED


def test_a_name_whose_hash_does_not_come_out_is_refused() -> None:
    assert refusal(forged(lambda body: body.update(name=b"n" * 32))) is DropReason.WRONG_NAME
    assert refusal(forged(lambda body: body.update(digest=bytes(32)))) is DropReason.WRONG_NAME
    assert refusal(forged(lambda body: body.update(owner=b"\x02" + bytes(32)))) is DropReason.WRONG_NAME


def test_an_owners_key_that_is_no_point_is_refused() -> None:
    subject = Subject(bytes(32), b"\x02" + b"\xff" * 32)
    assert refusal(advertisement(subject=subject, chain=[adcert(subject=subject)])) is DropReason.MALFORMED


def test_a_member_of_a_foreign_domain_is_refused() -> None:
    assert refusal(advertisement(STRANGER)) is DropReason.WRONG_DOMAIN


def test_a_member_of_a_trusted_domain_is_believed() -> None:
    at = AdvertisementVerifier(Policy(SCHOOL.root, [CLOUD.root]))
    assert at.verify(advertisement(STRANGER), NOW).domain == CLOUD.root.domain


def test_an_advertisement_under_anothers_membership_is_refused() -> None:
    body = UnverifiedAdvertisement.from_statement(parse(advertisement(GATEWAY))).to_fields()
    assert refusal(sign(StatementType.ADVERTISE, body, ROBOT.name, ROBOT.key)) is DropReason.BAD_CERTIFICATE


def test_an_advertisement_signed_by_another_is_refused() -> None:
    body = UnverifiedAdvertisement.from_statement(parse(GOOD)).to_fields()
    assert refusal(sign(StatementType.ADVERTISE, body, ROBOT.name, GATEWAY.key)) is DropReason.BAD_SIGNATURE


def test_an_rtcert_of_another_node_is_refused() -> None:
    assert refusal(advertisement(rtcert=RtCert.make(GATEWAY, SWITCH.name, DAY))) is DropReason.NOT_DELEGATED


def test_an_rtcert_of_another_node_is_refused_also_when_it_was_seen_before() -> None:
    at = verifier()
    at.verify(advertisement(GATEWAY), NOW)
    assert refusal(advertisement(rtcert=RtCert.make(GATEWAY, SWITCH.name, DAY)), at) is DropReason.NOT_DELEGATED


def test_an_rtcert_signed_by_another_is_refused() -> None:
    wire = sign(StatementType.RTCERT, {"switch": SWITCH.name, **VALIDITY.to_fields(DAY)}, ROBOT.name, GATEWAY.key)
    assert refusal(advertisement(rtcert=wire)) is DropReason.BAD_SIGNATURE


def test_an_rtcert_that_has_run_out_is_refused() -> None:
    assert refusal(advertisement(rtcert=RtCert.make(ROBOT, SWITCH.name, HOUR)), unix_s=LATER) is DropReason.EXPIRED


def test_a_membership_that_has_run_out_is_refused() -> None:
    assert refusal(GOOD, unix_s=UNTIL + 4_000) is DropReason.EXPIRED


def test_what_was_seen_before_still_runs_out() -> None:
    at = verifier()
    wire = advertisement(chain=[adcert(validity=HOUR)])
    at.verify(wire, NOW)
    assert refusal(wire, at, LATER) is DropReason.EXPIRED


@pytest.mark.parametrize("lease_ms", [0, 999, 3_600_001, 1 << 63])
def test_a_lease_out_of_bounds_is_refused(lease_ms: int) -> None:
    assert refusal(forged(lambda body: body.update(lease=lease_ms))) is DropReason.LEASE_BOUNDS


@pytest.mark.parametrize("lease_s", [0.5, 3_601.0, -1.0, 0.999])
def test_a_lease_out_of_bounds_is_not_asked_for(lease_s: float) -> None:
    with pytest.raises(LocalError):
        advertisement(lease_s=lease_s)


@pytest.mark.parametrize("field", ["name", "digest", "owner", "right", "seq", "inc", "lease", "member", "chain", "rt"])
def test_an_advertisement_that_lacks_a_field_is_malformed(field: str) -> None:
    assert refusal(forged(lambda body: body.pop(field))) is DropReason.MALFORMED


def test_another_statement_is_no_advertisement() -> None:
    assert refusal(adcert()) is DropReason.MALFORMED


@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255))
def test_every_changed_byte_is_refused_with_a_reason(at: int, change: int) -> None:
    altered = bytearray(GOOD)
    altered[at] ^= change
    refusal(bytes(altered))


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_malformed(wire: bytes) -> None:
    assert refusal(wire) is DropReason.MALFORMED


@given(st.sampled_from(["member", "rt", "chain"]), st.binary(max_size=100))
def test_arbitrary_evidence_is_refused_with_a_reason(field: str, evidence: bytes) -> None:
    refusal(forged(lambda body: body.update({field: [evidence] if field == "chain" else evidence})))


def test_an_advertisement_holds_no_longer_than_its_evidence() -> None:
    assert verifier().verify(GOOD, NOW).valid_until_unix_s == UNTIL
    assert (
        verifier().verify(advertisement(chain=[adcert(validity=HOUR)]), NOW).valid_until_unix_s == HOUR.not_after_unix_s
    )


def take(at: AdvertisementVerifier, wire: bytes) -> Revocation | None:
    return at.revoked.receive_revocation(parse(wire), b"a neighbour", Timestamps(0.0, NOW), lambda _: True)


def by_owner(fingerprint: bytes) -> bytes:
    return LAB.revoke(CAMERA, fingerprint, UNTIL)


def by_school(fingerprint: bytes) -> bytes:
    return Revocation.make(SCHOOL.key, SCHOOL.root.subject, fingerprint, UNTIL)


def by_robot(fingerprint: bytes) -> bytes:
    return Revocation.make(ROBOT.key, ROBOT.subject, fingerprint, UNTIL)


@pytest.mark.parametrize(
    ("revoke", "which"),
    [(by_school, "membership"), (by_owner, "AdCert"), (by_robot, "RtCert")],
)
def test_what_is_revoked_closes_what_it_opened(revoke: Callable[[bytes], bytes], which: str) -> None:
    at = verifier()
    found = at.verify(GOOD, NOW)
    fingerprints = {
        "membership": found.member.fingerprint,
        "AdCert": found.chain.links[0].fingerprint,
        "RtCert": found.rtcert.fingerprint,
    }
    revocation = take(at, revoke(fingerprints[which]))
    assert revocation is not None
    assert revocation.fingerprint in found.fingerprints
    assert refusal(GOOD, at) is DropReason.REVOKED
    with pytest.raises(StatementError) as caught:
        at.recheck(found, NOW)
    assert caught.value.reason is DropReason.REVOKED


def test_a_stranger_revokes_nothing() -> None:
    at = verifier()
    found = at.verify(GOOD, NOW)
    for fingerprint in found.fingerprints:
        take(at, Revocation.make(STRANGER.key, STRANGER.subject, fingerprint, UNTIL))
    assert at.verify(GOOD, NOW) == found
    at.recheck(found, NOW)


def test_an_owner_cannot_revoke_a_membership() -> None:
    at = verifier()
    take(at, by_owner(at.verify(GOOD, NOW).member.fingerprint))
    assert at.verify(GOOD, NOW).node == ROBOT.name


@pytest.mark.parametrize("who", ["owner", "gateway"])
def test_the_owner_and_the_issuer_revoke_a_link_further_down(who: str) -> None:
    at = verifier()
    wire = advertisement(chain=[adcert(GATEWAY, may_delegate=True), adcert(issuer=GATEWAY)])
    last = at.verify(wire, NOW).chain.links[1].fingerprint
    statement = by_owner(last) if who == "owner" else Revocation.make(GATEWAY.key, GATEWAY.subject, last, UNTIL)
    take(at, statement)
    assert refusal(wire, at) is DropReason.REVOKED


def test_a_node_cannot_revoke_the_link_above_its_own() -> None:
    at = verifier()
    wire = advertisement(chain=[adcert(GATEWAY, may_delegate=True), adcert(issuer=GATEWAY)])
    first = at.verify(wire, NOW).chain.links[0].fingerprint
    take(at, Revocation.make(GATEWAY.key, GATEWAY.subject, first, UNTIL))
    assert at.verify(wire, NOW).node == ROBOT.name


def test_a_refreshed_advertisement_costs_one_signature_check(monkeypatch: pytest.MonkeyPatch) -> None:
    at, checks = verifier(), [0]
    first, second = advertisement(chain=[link := adcert()], rtcert=(rt := RtCert.make(ROBOT, SWITCH.name, DAY))), b""
    second = advertisement(chain=[link], rtcert=rt, sequence=2)
    genuine = PublicKey._verify

    def counted(*arguments: object) -> None:
        checks[0] += 1
        genuine(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(PublicKey, "_verify", counted)
    at.verify(first, NOW)
    assert checks[0] == 4  # membership, advertisement, RtCert, AdCert
    at.verify(second, NOW)
    assert checks[0] == 5
