"""Introductions: a reader's proof of itself, and refused ones."""

from __future__ import annotations

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.introduction import INTRODUCTION_BYTES, Introduction
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, StatementError

KEY = SigningKey.generate()
READER = Subject(hashlib.sha256(b"metadata").digest(), KEY.public.compressed)
WIRE = Introduction.make(READER, KEY, 5, 1_000, b"x" * 32)


def reason_of(wire: bytes, subject: Subject = READER, incarnation: int = 5) -> DropReason:
    with pytest.raises(StatementError) as caught:
        Introduction.from_wire(wire, subject.name, incarnation)
    return caught.value.reason


def test_what_was_made_reads_back() -> None:
    assert Introduction.from_wire(WIRE, READER.name, 5) == Introduction(READER.name, 5, 1_000, b"x" * 32)


def test_it_proves_one_life_of_one_name() -> None:
    other = Subject(READER.digest, SigningKey.generate().public.compressed)
    assert reason_of(WIRE, other) is DropReason.WRONG_NAME
    assert reason_of(WIRE, incarnation=6) is DropReason.BAD_SIGNATURE


def test_another_key_cannot_sign_for_a_name() -> None:
    assert reason_of(Introduction.make(READER, SigningKey.generate(), 5, 1_000, b"x" * 32)) is DropReason.BAD_SIGNATURE


@pytest.mark.parametrize("at", range(INTRODUCTION_BYTES))
def test_no_bit_of_it_may_change(at: int) -> None:
    changed = bytearray(WIRE)
    changed[at] ^= 1
    reason_of(bytes(changed))


@given(st.binary(max_size=2 * INTRODUCTION_BYTES))
def test_arbitrary_bytes_are_refused(wire: bytes) -> None:
    reason_of(wire)
