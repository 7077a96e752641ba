"""Sealed control datagrams between members: those that open, and those that do not."""

from __future__ import annotations

import json
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.control_seal import (
    JUMP_MAX,
    ControlContext,
    ControlOpener,
    ControlReplayWindow,
    ControlSealer,
    control_key,
    topic_of,
)
from gdp.crypto.envelope import seal_key
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import HEADER_BYTES, HOPS_AT, Flag, Header, Kind, decode, encode

SHARED, SECRET, READER, PUBLISHER, TOPIC = b"x" * 32, b"s" * 32, b"r" * 32, b"p" * 32, b"t" * 32
KEY = control_key(SHARED, SECRET, Kind.ACKNACK, READER, 5, PUBLISHER, 9, TOPIC)


def sealer(topic: bytes = TOPIC, first: int = 1) -> ControlSealer:
    return ControlSealer(
        key=KEY, epoch=1, context=ControlContext(Kind.ACKNACK, READER, 5, PUBLISHER, 9, topic), numbers=count(first)
    )


def opener(topic: bytes = TOPIC, incarnation: int = 9) -> ControlOpener:
    return ControlOpener(KEY, topic, incarnation)


def reason_of(to: ControlOpener, frame: bytes) -> DropReason:
    with pytest.raises(EnvelopeError) as caught:
        to.open(decode(frame), frame)
    return caught.value.reason


def refused(numbers: ControlReplayWindow, number: int, now_s: float = 0.0) -> DropReason:
    with pytest.raises(EnvelopeError) as caught:
        numbers.check(number, now_s)
    return caught.value.reason


def test_a_published_note_is_sealed_again_to_the_byte() -> None:
    vectors = json.loads((Path(__file__).parents[2] / "vectors" / "envelope.json").read_text())
    for note in vectors["notes"]:
        names = [bytes.fromhex(note[key]) for key in ("secret", "source", "destination", "topic")]
        secret, source, destination, topic = names
        incarnation, to_incarnation = int(note["incarnation"]), int(note["destination_incarnation"])
        if note["kind"] == Kind.INTRODUCTION:
            key = seal_key(secret, note["kind"], source, incarnation, destination)
        else:
            shared = bytes.fromhex(note["shared"])
            key = control_key(shared, secret, note["kind"], source, incarnation, destination, to_incarnation, topic)
        assert key.hex() == note["key"]
        numbers = count(int(note["number"]))
        made = ControlSealer(
            key=key,
            epoch=note["epoch"],
            context=ControlContext(note["kind"], source, incarnation, destination, to_incarnation, topic),
            numbers=numbers,
        )
        assert made.seal(bytes.fromhex(note["body"])).hex() == note["frame"]


@given(st.binary(max_size=500))
def test_a_note_opens_with_padding_behind_it(body: bytes) -> None:
    frame = sealer().seal(body)
    assert opener().open(decode(frame), frame + bytes(7)) == body


def test_an_older_number_than_the_last_is_a_replay() -> None:
    numbers = ControlReplayWindow()
    numbers.check(2, 0.0)
    numbers.check(1, 0.0)  # a datagram that did not open moves nothing
    numbers.accept(2, 0.0)
    assert refused(numbers, 1) is refused(numbers, 2) is DropReason.REPLAYED


def test_how_far_ahead_a_number_may_be_grows_with_time() -> None:
    numbers = ControlReplayWindow()
    numbers.check(1 << 60, 0.0)
    numbers.accept(5, 0.0)
    numbers.check(5 + JUMP_MAX, 0.0)
    assert refused(numbers, 5 + JUMP_MAX + 1) is DropReason.MALFORMED
    numbers.check(5 + JUMP_MAX + 100_000, 1.0)
    assert refused(numbers, 5 + JUMP_MAX + 100_001, 1.0) is DropReason.MALFORMED


def test_a_note_about_another_topic_or_to_another_life_does_not_open() -> None:
    frame = sealer().seal(b"x")
    assert reason_of(opener(topic=b"u" * 32), frame) is DropReason.BAD_TAG
    assert reason_of(opener(incarnation=8), frame) is DropReason.BAD_TAG


def test_whatever_differs_makes_another_key() -> None:
    keys = {
        control_key(shared, secret, kind, source, incarnation, destination, to_incarnation, topic)
        for shared, secret, kind, source, incarnation, destination, to_incarnation, topic in (
            (b"X" * 32, SECRET, Kind.ACKNACK, READER, 5, PUBLISHER, 9, TOPIC),
            (SHARED, b"S" * 32, Kind.ACKNACK, READER, 5, PUBLISHER, 9, TOPIC),
            (SHARED, SECRET, Kind.DATA, READER, 5, PUBLISHER, 9, TOPIC),
            (SHARED, SECRET, Kind.ACKNACK, b"q" * 32, 5, PUBLISHER, 9, TOPIC),
            (SHARED, SECRET, Kind.ACKNACK, READER, 6, PUBLISHER, 9, TOPIC),
            (SHARED, SECRET, Kind.ACKNACK, READER, 5, b"Q" * 32, 9, TOPIC),
            (SHARED, SECRET, Kind.ACKNACK, READER, 5, PUBLISHER, 8, TOPIC),
            (SHARED, SECRET, Kind.ACKNACK, READER, 5, PUBLISHER, 9, b"u" * 32),
        )
    }
    assert len(keys | {KEY}) == 9


def test_two_sealers_that_share_numbers_make_no_nonce_twice() -> None:
    numbers = count(1)
    two = [
        ControlSealer(
            key=KEY, epoch=1, context=ControlContext(Kind.ACKNACK, READER, 5, PUBLISHER, 9, topic), numbers=numbers
        )
        for topic in (TOPIC, b"u" * 32)
    ]
    assert len({decode(each.seal(b"x")).number for _ in range(5) for each in two}) == 10


def test_only_hops_left_may_change_on_the_way() -> None:
    frame = sealer().seal(b"body")
    topic = range(HEADER_BYTES, HEADER_BYTES + 32)  # selects the opener; another topic's opener will not open it
    for at in (at for at in range(len(frame)) if at != HOPS_AT and at not in topic):
        changed = bytearray(frame)
        changed[at] ^= 1
        header = decode(frame)._replace(number=int.from_bytes(changed[8:16], "big"))
        with pytest.raises(EnvelopeError):
            opener().open(header, bytes(changed))


@given(st.binary(max_size=120))
def test_arbitrary_payloads_are_refused(payload: bytes) -> None:
    header = Header(Kind.ACKNACK, Flag.LAST, 1, 1, len(payload), 1, 0, 1, 5, PUBLISHER, READER)
    frame = encode(header) + payload
    with pytest.raises(EnvelopeError):
        opener().open(header, frame)
    if len(payload) < 48:
        with pytest.raises(EnvelopeError):
            topic_of(header, frame)
    else:
        assert topic_of(header, frame) == payload[:32]
