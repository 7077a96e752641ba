"""Attacks with a recorded tunnel: who opens its X25519 later does not come to its preshared key."""

from __future__ import annotations

import contextlib
import os

import pytest

from gdp.control.preshared_key import NO_KEY, PresharedKeyAgreement
from gdp.crypto.kem import KEM_PUBLIC_BYTES
from gdp.errors import DropReason, StatementError
from tests.gdp.control.members import node

ENDS = sorted((node("a"), node("b")), key=lambda each: each.name)
FIRST, SECOND = (b"session 1" + ENDS[0].name, b"session 2" + ENDS[1].name)


def agreed() -> tuple[PresharedKeyAgreement, PresharedKeyAgreement, list[bytes]]:
    """Return both ends after an agreement, and the messages that a recorder has seen."""
    first, second = (PresharedKeyAgreement(ENDS[n].name, ENDS[1 - n].name, os.urandom) for n in (0, 1))
    seen = []
    for _ in range(3):
        first.receive(second.message, FIRST, SECOND)
        second.receive(first.message, SECOND, FIRST)
        seen += [first.message, second.message]
    first.receive(second.message, FIRST, SECOND)
    assert first.key == second.key != NO_KEY
    return first, second, seen


def test_n52_kept_keys_open_no_preshared_key() -> None:
    first, second, seen = agreed()
    (sealed,) = {each for each in seen if KEM_PUBLIC_BYTES > len(each) > 1_000}
    for identity in ENDS:
        with pytest.raises(StatementError) as refused:
            identity.kem.open(sealed, first._info)
        assert refused.value.reason is DropReason.BAD_TAG
    assert all(second.key not in each for each in seen)


def test_n52_each_agreement_has_a_kem_key_and_a_preshared_key_of_its_own() -> None:
    (one, _, seen), (other, _, seen_again) = agreed(), agreed()
    assert one.key != other.key
    assert not set(seen) & set(seen_again)


def test_n52_what_an_earlier_session_agreed_on_is_worth_nothing_in_another() -> None:
    first, second, seen = agreed()
    for end, own, far in ((first, b"session 3", SECOND), (second, b"session 4", FIRST)):
        for message in seen:
            with contextlib.suppress(StatementError):  # not sealed to its key
                end.receive(message, own, far)
            assert end.key == NO_KEY


def test_n52_a_kem_key_is_forgotten_as_soon_as_it_has_opened_the_secret() -> None:
    first, _, _ = agreed()
    assert first._private is None
