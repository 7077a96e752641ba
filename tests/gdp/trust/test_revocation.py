"""Revocations: permitted issuers, storage, retention, and quotas that separate origins and roots."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import Statement, StatementType, parse, sign
from gdp.crypto.subject import SUBJECT, Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CERTIFICATE_LIFE_MAX_S
from gdp.metadata import Metadata
from gdp.sansio import Timestamps
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import OPERATOR, Revocations, hash_of
from tests.gdp.trust.world import CAMERA, CLOUD, LAB, NOW, ROBOT, SCHOOL

ROOTS = {SCHOOL.root.key.compressed: SCHOOL.root.domain}
AT = Timestamps(100.0, NOW)
OTHER = SigningKey.generate()
OTHERS = Subject.of(Metadata({"kind": "topic", "name": "/other"}), OTHER.public.compressed)


def by_root(number: int, until: int = NOW + 100) -> Statement:
    return parse(Revocation.make(SCHOOL.key, SCHOOL.root.subject, fingerprint(number), until))


def by_lab(number: int, until: int = NOW + 100) -> Statement:
    return parse(LAB.revoke(CAMERA, fingerprint(number), until))


def by_other(number: int) -> Statement:
    return parse(Revocation.make(OTHER, OTHERS, fingerprint(number), NOW + 100))


def fingerprint(number: int) -> bytes:
    return number.to_bytes(32, "big")


def take(revoked: Revocations, statement: Statement, origin: bytes = b"a", at: Timestamps = AT) -> Revocation | None:
    return revoked.receive_revocation(statement, origin, at, lambda _: True)


def refusal(revoked: Revocations, statement: Statement, origin: bytes = b"a", at: Timestamps = AT) -> DropReason:
    with pytest.raises(StatementError) as caught:
        take(revoked, statement, origin, at)
    return caught.value.reason


def has(revoked: Revocations, number: int) -> bool:
    return revoked.has(fingerprint(number), CAMERA.owner_key)


def test_a_revocation_comes_back_verified() -> None:
    wire = LAB.revoke(CAMERA, bytes(32), NOW)
    assert Revocation.from_statement(parse(wire)) == Revocation(bytes(32), CAMERA, NOW)


def test_a_revocation_by_another_key_is_refused() -> None:
    wire = Revocation.make(SigningKey.generate(), CAMERA, bytes(32), NOW)
    assert refusal(Revocations(ROOTS), parse(wire)) is DropReason.BAD_SIGNATURE


def test_a_revocation_in_anothers_name_is_refused() -> None:
    body = {**SUBJECT.to_fields(ROBOT.subject), "cert": bytes(32), "until": NOW}
    with pytest.raises(StatementError) as caught:
        Revocation.from_statement(parse(sign(StatementType.REVOKE, body, CAMERA.name, ROBOT.key)))
    assert caught.value.reason is DropReason.WRONG_NAME


def test_an_owner_takes_back_only_what_is_its_own() -> None:
    with pytest.raises(LocalError):
        LAB.revoke(ROBOT.subject, bytes(32), NOW)


@pytest.mark.parametrize("make", [by_lab, by_root])
def test_new_revocations_are_distinguished_from_known_ones(make: Callable[..., Statement]) -> None:
    revoked, statement = Revocations(ROOTS), make(1)
    assert take(revoked, statement) is not None
    assert take(revoked, statement) is None
    assert len(revoked) == 1
    assert revoked.has(fingerprint(1), Revocation.read(statement).issuer.owner_key)
    assert not revoked.has(fingerprint(1), ROBOT.key.public.compressed)


@pytest.mark.parametrize("make", [by_lab, by_root])
def test_a_statement_comes_out_as_it_went_in(make: Callable[..., Statement]) -> None:
    revoked, statement = Revocations(ROOTS), make(1)
    take(revoked, statement)
    assert revoked.wire(Revocation.read(statement).issuer.owner_key, fingerprint(1)) == statement.wire


def test_a_statement_of_a_later_form_comes_out_whole() -> None:
    body = {**SUBJECT.to_fields(SCHOOL.root.subject), "cert": fingerprint(1), "until": NOW + 100, "why": "stolen"}
    statement = parse(sign(StatementType.REVOKE, body, SCHOOL.root.domain, SCHOOL.key))
    revoked = Revocations(ROOTS)
    take(revoked, statement)
    assert revoked.wire(SCHOOL.root.key.compressed, fingerprint(1)) == statement.wire


@pytest.mark.parametrize("make", [by_lab, by_root])
def test_it_is_kept_until_the_certificate_would_have_run_out(make: Callable[..., Statement]) -> None:
    revoked = Revocations(ROOTS)
    take(revoked, make(1))
    take(revoked, make(2, NOW + 9_000), at=Timestamps(5_000.0, NOW + 5_000))
    assert len(revoked) == 1
    assert [number for _, number in revoked.keys()] == [fingerprint(2)]  # noqa: SIM118


@pytest.mark.parametrize("make", [by_lab, by_root])
def test_a_later_end_replaces_an_earlier_one(make: Callable[..., Statement]) -> None:
    revoked = Revocations(ROOTS)
    take(revoked, make(1))
    assert take(revoked, make(1, NOW + 9_000)) is not None
    take(revoked, make(2, NOW + 9_000), at=Timestamps(5_000.0, NOW + 5_000))
    assert len(revoked) == 2


def test_what_has_run_out_needs_no_revocation() -> None:
    assert refusal(Revocations(ROOTS), by_lab(1), at=Timestamps(0.0, NOW + 5_000)) is DropReason.EXPIRED


def test_a_revocation_for_longer_than_a_certificate_can_hold_is_refused() -> None:
    late = NOW + int(CERTIFICATE_LIFE_MAX_S) + 1
    assert refusal(Revocations(ROOTS), by_lab(1, late)) is DropReason.MALFORMED
    assert refusal(Revocations(ROOTS), by_root(1, (1 << 64) - 1)) is DropReason.MALFORMED


def test_whose_certificates_are_not_held_is_refused_before_its_signature_is_looked_at() -> None:
    revoked = Revocations(ROOTS)
    forged = parse(Revocation.make(SigningKey.generate(), CAMERA, bytes(32), NOW))
    for statement in (by_lab(1), forged, parse(Revocation.make(CLOUD.key, CLOUD.root.subject, bytes(32), NOW))):
        with pytest.raises(StatementError) as caught:
            revoked.receive_revocation(statement, b"a", AT, lambda _: False)
        assert caught.value.reason is DropReason.UNCONCERNED
    assert len(revoked) == 0


def test_a_revocation_of_the_operator_is_kept_for_any_issuer() -> None:
    revoked = Revocations(ROOTS, per_issuer=2, per_origin=2, of_owners=2)
    for number in range(5):
        assert revoked.receive_revocation(by_lab(number), OPERATOR, AT, lambda _: False) is not None
    refusal(revoked, by_other(1))
    assert all(has(revoked, number) for number in range(5))


def test_a_known_one_that_the_operator_inserts_never_gives_way() -> None:
    revoked = Revocations(ROOTS, of_owners=3)
    for number in range(3):
        take(revoked, by_lab(number))
    assert take(revoked, by_lab(0), OPERATOR) is None
    take(revoked, by_other(0), b"b")
    assert [has(revoked, number) for number in range(3)] == [True, False, True]


def test_one_owner_has_a_share_that_others_do_not_pay_for() -> None:
    revoked = Revocations(ROOTS, per_issuer=3)
    for number in range(3):
        take(revoked, by_lab(number))
    assert refusal(revoked, by_lab(3), b"b") is DropReason.QUOTA
    assert take(revoked, by_other(0)) is not None


def test_who_gives_too_many_gives_up_its_own_only() -> None:
    revoked = Revocations(ROOTS, of_owners=4)
    take(revoked, by_other(0), b"b")
    for number in range(3):
        take(revoked, by_lab(number), b"a")
    assert refusal(revoked, by_lab(3), b"a") is DropReason.QUOTA  # its own owner has most of its quota already
    assert take(revoked, by_other(1), b"b") is not None
    assert [has(revoked, number) for number in range(3)] == [False, True, True]
    assert refusal(revoked, by_other(2), b"b") is DropReason.QUOTA
    assert revoked.has(fingerprint(0), OTHER.public.compressed)


def test_within_a_givers_share_the_owner_that_has_most_gives_way() -> None:
    revoked = Revocations(ROOTS, per_origin=3)
    for number in range(3):
        take(revoked, by_lab(number))
    assert take(revoked, by_other(0)) is not None
    assert [has(revoked, number) for number in range(3)] == [False, True, True]
    assert refusal(revoked, by_lab(3)) is DropReason.QUOTA


def test_roots_have_capacity_that_no_other_key_can_fill() -> None:
    revoked = Revocations(ROOTS, of_owners=2)
    for number in range(2):
        take(revoked, by_lab(number), b"ab"[number : number + 1])
    assert take(revoked, by_root(3)) is not None
    assert refusal(revoked, by_other(3), b"c") is DropReason.QUOTA


def test_an_origin_has_a_rate_and_another_one_is_not_delayed() -> None:
    revoked = Revocations(ROOTS, per_issuer=10_000)
    reasons = set()
    for number in range(600):
        try:
            revoked.receive_revocation(by_other(number), b"a", AT, lambda _: False)
        except StatementError as error:
            reasons.add(error.reason)
    assert reasons == {DropReason.UNCONCERNED, DropReason.QUOTA}
    assert refusal(revoked, by_lab(1), b"a") is DropReason.QUOTA
    assert take(revoked, by_lab(1), b"b") is not None
    assert take(revoked, by_root(1), b"a") is not None


def test_a_forged_one_costs_its_origin_as_much_as_65_of_its_burst_of_4096() -> None:
    revoked = Revocations(ROOTS)
    for number in range(63):
        body = {**SUBJECT.to_fields(SCHOOL.root.subject), "cert": fingerprint(number), "until": NOW + 100}
        forged = parse(sign(StatementType.REVOKE, body, SCHOOL.root.domain, OTHER))
        assert refusal(revoked, forged) is DropReason.BAD_SIGNATURE
    assert take(revoked, by_root(1)) is not None
    assert refusal(revoked, by_root(2)) is DropReason.QUOTA
    assert take(revoked, by_root(2), b"b") is not None


def test_totals_are_equal_where_the_same_is_kept() -> None:
    one, two = Revocations(ROOTS), Revocations(ROOTS)
    for number in range(20):
        take(one, by_root(number << 248))
    for number in reversed(range(20)):
        take(two, by_root(number << 248))
    school = hash_of(SCHOOL.key.public.compressed)
    assert one.sets[school].total == two.sets[school].total != bytes(8)
    take(two, by_root(7, NOW + 200))
    assert one.sets[school].total != two.sets[school].total
    assert hash_of(CLOUD.key.public.compressed) not in one.sets


def test_what_a_name_lost_has_a_digest() -> None:
    one, two = Revocations(ROOTS), Revocations(ROOTS)
    assert one.digest_about(CAMERA.name) == bytes(8)
    take(one, by_lab(1))
    take(one, by_other(1))
    again = by_lab(1)  # with another signature
    take(two, again, b"c")
    assert one.digest_about(CAMERA.name) == two.digest_about(CAMERA.name) != bytes(8)
    assert two.about(CAMERA.name) == [again.wire]
