"""Attacks with a machine that is snapshotted in operation and resumed twice: both copies continue with one state."""

from __future__ import annotations

import os
from itertools import count
from os import urandom

import pytest

from gdp.burst.cipher import SALT_BYTES
from gdp.crypto.control_seal import ControlContext, ControlSealer
from gdp.crypto.envelope import SIGNATURE_BYTES, KeyContext, Sealer
from gdp.crypto.records import RecordKey
from gdp.frame.codec import HEADER_BYTES, Kind
from gdp.names import NAME_BYTES
from gdp.nodes.membership import fresh_bytes, incarnation
from tests.gdp.message.sealed import INCARNATION, SECRET, SOURCE, TOPIC, WRITER

ONE, OTHER = b"the gripper opens, slowly and wide", b"the gripper closes, fast and tight"


def xor(a: bytes, b: bytes) -> bytes:
    return bytes(x ^ y for x, y in zip(a, b, strict=True))


def test_a32_copies_of_a_publisher_do_not_repeat_a_nonce() -> None:
    copies = [
        Sealer(
            secret=SECRET,
            epoch=1,
            context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC),
            signer=WRITER,
            random_bytes=urandom,
        )
        for _ in range(2)
    ]
    for number in range(1, 100):
        bodies = [
            copy.seal(number, 0, message, 1_500)[0][HEADER_BYTES + SALT_BYTES : -SIGNATURE_BYTES - 16]
            for copy, message in zip(copies, (ONE, OTHER), strict=True)
        ]
        assert xor(*bodies) != xor(ONE, OTHER)


def test_a32_what_was_drawn_before_the_snapshot_seals_nothing_after_it() -> None:
    drawn: list[bytes] = []

    def draw(size: int) -> bytes:
        drawn.append(urandom(size))
        return drawn[-1]

    sealer = Sealer(
        secret=SECRET,
        epoch=1,
        context=KeyContext(Kind.DATA, SOURCE, INCARNATION, TOPIC),
        signer=WRITER,
        random_bytes=draw,
    )
    for number in range(1, 5):
        assert len(drawn) == number - 1
        frame = sealer.seal(number, 0, ONE, 1_500)[0]
        assert frame[HEADER_BYTES : HEADER_BYTES + SALT_BYTES] == drawn[-1]


def test_a32_copies_of_a_reader_that_use_one_number_give_no_plaintext_away() -> None:
    made = [
        ControlSealer(
            key=b"k" * 32, epoch=1, context=ControlContext(Kind.ACKNACK, SOURCE, 5, TOPIC, 9, TOPIC), numbers=count(7)
        ).seal(body)
        for body in (ONE, OTHER)
    ]
    bodies = [note[HEADER_BYTES + NAME_BYTES : -16] for note in made]
    assert made[0][:HEADER_BYTES] == made[1][:HEADER_BYTES]
    assert xor(*bodies) != xor(ONE, OTHER)


def test_a32_copies_of_a_channel_that_use_one_number_give_no_plaintext_and_no_key_away() -> None:
    """Under GCM two records of one number give away the key of their tags; GCM-SIV is made for this (RFC 8452)."""
    bodies = [RecordKey(b"k" * 32).seal(7, b"head", body)[:-16] for body in (ONE, OTHER)]
    assert xor(*bodies) != xor(ONE, OTHER)


def test_a32_the_records_of_a_channel_are_those_of_rfc_8452() -> None:
    key = RecordKey(bytes.fromhex("01".ljust(64, "0")))  # appendix C.2, the second vector
    sealed = "c2ef328e5c71c83b843122130f7364b761e0b97427e3df28"
    assert key.seal(3 << 88, b"", bytes([1]).ljust(8, b"\0")).hex() == sealed


def test_a32_fresh_bytes_differ_even_where_the_generator_repeats_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "urandom", bytes)
    assert len({fresh_bytes(8) for _ in range(100)}) == 100
    assert len({incarnation() for _ in range(100)}) == 100
    assert {len(fresh_bytes(size)) for size in (8, 32, 64)} == {8, 32, 64}
