"""Notes between members: what opens, and what does not."""

from __future__ import annotations

import json
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.note import NoteOpener, NoteSealer, topic_of
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import HEADER_BYTES, HOPS_AT, Header, decode, encode
from gdp.frame.kinds import Flag, Kind

SECRET, READER, PUBLISHER, TOPIC = b"s" * 32, b"r" * 32, b"p" * 32, b"t" * 32


def sealer(topic: bytes = TOPIC, first: int = 1) -> NoteSealer:
    return NoteSealer(SECRET, 1, Kind.REPORT, READER, 5, PUBLISHER, topic, 9, count(first))


def opener(topic: bytes = TOPIC, incarnation: int = 9) -> NoteOpener:
    return NoteOpener(SECRET, Kind.REPORT, READER, 5, PUBLISHER, topic, incarnation)


def reason_of(to: NoteOpener, frame: bytes) -> DropReason:
    with pytest.raises(EnvelopeError) as caught:
        to.open(decode(frame), frame)
    return caught.value.reason


def test_a_published_note_is_sealed_again_to_the_byte() -> None:
    vectors = json.loads((Path(__file__).parents[2] / "vectors" / "envelope.json").read_text())
    for note in vectors["notes"]:
        names = [bytes.fromhex(note[key]) for key in ("secret", "source", "destination", "topic")]
        secret, source, destination, topic = names
        incarnations = int(note["incarnation"]), int(note["destination_incarnation"])
        numbers = count(int(note["number"]))
        made = NoteSealer(
            secret, note["epoch"], note["kind"], source, incarnations[0], destination, topic, incarnations[1], numbers
        )
        assert made.seal(bytes.fromhex(note["body"])).hex() == note["frame"]


@given(st.binary(max_size=500))
def test_a_note_opens_once(body: bytes) -> None:
    to, frame = opener(), sealer().seal(body)
    assert to.open(decode(frame), frame + bytes(7)) == body
    assert reason_of(to, frame) is DropReason.REPLAYED


def test_an_older_note_than_the_last_is_a_replay() -> None:
    to, by = opener(), sealer()
    first, second = by.seal(b"1"), by.seal(b"2")
    to.open(decode(second), second)
    assert reason_of(to, first) is DropReason.REPLAYED


def test_a_note_about_another_topic_or_to_another_life_does_not_open() -> None:
    frame = sealer().seal(b"x")
    assert reason_of(opener(topic=b"u" * 32), frame) is DropReason.BAD_TAG
    assert reason_of(opener(incarnation=8), frame) is DropReason.BAD_TAG


def test_a_note_that_does_not_open_does_not_move_the_replay_bound() -> None:
    to = opener()
    forged = bytearray(sealer(first=1_000).seal(b"x"))
    forged[-1] ^= 1
    assert reason_of(to, bytes(forged)) is DropReason.BAD_TAG
    frame = sealer().seal(b"y")
    assert to.open(decode(frame), frame) == b"y"


def test_two_sealers_that_share_numbers_make_no_nonce_twice() -> None:
    numbers = count(1)
    two = [NoteSealer(SECRET, 1, Kind.REPORT, READER, 5, PUBLISHER, topic, 9, numbers) for topic in (TOPIC, b"u" * 32)]
    assert len({decode(each.seal(b"x")).number for _ in range(5) for each in two}) == 10


def test_only_hops_left_may_change_on_the_way() -> None:
    frame = sealer().seal(b"body")
    topic = range(HEADER_BYTES, HEADER_BYTES + 32)  # tells which opener to use; another topic's will not open it
    for at in (at for at in range(len(frame)) if at != HOPS_AT and at not in topic):
        changed = bytearray(frame)
        changed[at] ^= 1
        header = decode(frame)._replace(number=int.from_bytes(changed[8:16], "big"))
        with pytest.raises(EnvelopeError):
            opener().open(header, bytes(changed))


@given(st.binary(max_size=120))
def test_arbitrary_payloads_are_refused(payload: bytes) -> None:
    header = Header(Kind.REPORT, Flag.LAST, 1, 1, len(payload), 1, 0, 1, 5, PUBLISHER, READER)
    frame = encode(header) + payload
    with pytest.raises(EnvelopeError):
        opener().open(header, frame)
    if len(payload) < 48:
        with pytest.raises(EnvelopeError):
            topic_of(header, frame)
    else:
        assert topic_of(header, frame) == payload[:32]


def test_a_note_far_ahead_of_the_last_is_refused_and_the_next_real_one_opens() -> None:
    to, real = opener(), sealer()
    first = real.seal(b"1")
    to.open(decode(first), first)
    assert reason_of(to, sealer(first=(1 << 64) - 1).seal(b"bye")) is DropReason.MALFORMED
    second = real.seal(b"2")
    assert to.open(decode(second), second) == b"2"
