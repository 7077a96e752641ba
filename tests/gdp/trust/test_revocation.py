"""Revocations: who may, how long they are kept, and that strangers cannot crowd out the roots."""

from __future__ import annotations

import pytest

from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, parse, sign
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.trust.revocation import Revocation, Revocations
from tests.gdp.trust.world import CAMERA, LAB, NOW, ROBOT, SCHOOL

ROOT_KEYS = frozenset({SCHOOL.root.key.compressed})


def revocation(number: int, issuer: Subject = CAMERA, until: int = NOW + 100) -> Revocation:
    return Revocation(number.to_bytes(32, "big"), issuer, until)


def test_a_revocation_comes_back_verified() -> None:
    wire = LAB.revoke(CAMERA, bytes(32), NOW)
    assert Revocation.from_statement(parse(wire)) == Revocation(bytes(32), CAMERA, NOW)


def test_a_revocation_by_another_key_is_refused() -> None:
    wire = Revocation.make(SigningKey.generate(), CAMERA, bytes(32), NOW)
    with pytest.raises(StatementError) as caught:
        Revocation.from_statement(parse(wire))
    assert caught.value.reason is DropReason.BAD_SIGNATURE


def test_a_revocation_in_anothers_name_is_refused() -> None:
    body = {**ROBOT.subject.to_fields(), "cert": bytes(32), "until": NOW}
    with pytest.raises(StatementError) as caught:
        Revocation.from_statement(parse(sign(StatementType.REVOKE, body, CAMERA.name, ROBOT.key)))
    assert caught.value.reason is DropReason.WRONG_NAME


def test_an_owner_takes_back_only_what_is_its_own() -> None:
    with pytest.raises(LocalError):
        LAB.revoke(ROBOT.subject, bytes(32), NOW)


def test_what_is_new_is_told_from_what_is_known() -> None:
    revoked = Revocations(ROOT_KEYS)
    assert revoked.add(revocation(1), NOW)
    assert not revoked.add(revocation(1), NOW)
    assert revoked.has(revocation(1).fingerprint, CAMERA.owner_key)
    assert not revoked.has(revocation(1).fingerprint, ROBOT.key.public.compressed)


def test_it_is_kept_until_the_certificate_would_have_run_out() -> None:
    revoked = Revocations(ROOT_KEYS)
    revoked.add(revocation(1), NOW)
    revoked.add(revocation(2, until=NOW + 9_000), NOW + 5_000)
    assert not revoked.has(revocation(1).fingerprint, CAMERA.owner_key)
    assert len(revoked) == 1


def test_a_later_end_replaces_an_earlier_one() -> None:
    revoked = Revocations(ROOT_KEYS)
    revoked.add(revocation(1), NOW)
    assert revoked.add(revocation(1, until=NOW + 9_000), NOW)
    revoked.add(revocation(2, until=NOW + 9_000), NOW + 5_000)
    assert revoked.has(revocation(1).fingerprint, CAMERA.owner_key)


def test_what_has_run_out_needs_no_revocation() -> None:
    with pytest.raises(StatementError) as caught:
        Revocations(ROOT_KEYS).add(revocation(1), NOW + 5_000)
    assert caught.value.reason is DropReason.EXPIRED


def test_strangers_fill_their_own_room_only() -> None:
    revoked = Revocations(ROOT_KEYS, maximum=3)
    for number in range(3):
        revoked.add(revocation(number), NOW)
    with pytest.raises(StatementError) as caught:
        revoked.add(revocation(3), NOW)
    assert caught.value.reason is DropReason.QUOTA
    assert revoked.add(revocation(3, SCHOOL.root.subject), NOW)
