"""Statements in fragments: split, reassembled in any order, and bounded on any input."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.errors import DropReason, FrameError, LocalError
from gdp.frame.codec import HEADER_BYTES, Header, Kind, decode, encode
from gdp.limits import (
    CONTROL_JOIN_BYTES,
    CONTROL_JOIN_SOURCE_BYTES,
    CONTROL_MAX_BYTES,
    CONTROL_PARTS_MAX,
    CONTROL_PATIENCE_S,
    RECORD_OVERHEAD_BYTES,
)
from gdp.names import ZERO, Name

SOURCE = Name(b"s" * 32)
FAR = Name(b"f" * 32)


def fragmenter(incarnation: int = 7) -> ControlFragmenter:
    return ControlFragmenter(SOURCE, incarnation)


def join(reassembler: ControlReassembler, frames: list[bytes], now_s: float = 0.0) -> bytes | None:
    whole = None
    for frame in frames:
        whole = reassembler.add(decode(frame), frame, now_s)
    return whole


def beginning(source: bytes, number: int, size: int = 1_000, parts: int = 3, part: int = 0) -> bytes:
    return encode(Header(Kind.HELLO, 0, 1, 0, size, number, part, parts, 1, ZERO, source)) + bytes(size)


@given(st.binary(max_size=CONTROL_MAX_BYTES), st.integers(576, 9_000), st.randoms())
def test_what_was_split_is_joined_in_any_order(statement: bytes, mtu: int, chance: random.Random) -> None:
    frames = fragmenter().split(Kind.HELLO, statement, mtu)
    assert max(map(len, frames)) <= mtu
    chance.shuffle(frames)
    reassembler = ControlReassembler()
    assert join(reassembler, frames) == statement
    assert reassembler.held_bytes == 0


def test_a_statement_that_goes_far_fits_through_a_tunnel() -> None:
    assert max(map(len, fragmenter().split(Kind.RIB_REQUEST, bytes(9_000), 9_000, FAR))) <= 1_400


def test_a_statement_above_the_limit_is_not_sent() -> None:
    with pytest.raises(LocalError):
        fragmenter().split(Kind.HELLO, bytes(CONTROL_MAX_BYTES + RECORD_OVERHEAD_BYTES + 1), 1_500)


def test_two_statements_that_interleave_do_not_mix() -> None:
    ours = fragmenter()
    one, two = ours.split(Kind.HELLO, b"1" * 3_000, 1_500), ours.split(Kind.HELLO, b"2" * 3_000, 1_500)
    reassembler = ControlReassembler()
    found = [reassembler.add(decode(frame), frame, 0.0) for pair in zip(one, two, strict=True) for frame in pair]
    assert [each for each in found if each is not None] == [b"1" * 3_000, b"2" * 3_000]


def test_a_part_that_comes_twice_is_a_duplicate() -> None:
    reassembler, frame = ControlReassembler(), beginning(SOURCE, 1)
    join(reassembler, [frame])
    with pytest.raises(FrameError) as caught:
        join(reassembler, [frame])
    assert caught.value.reason is DropReason.DUPLICATE


def test_parts_whose_number_changes_are_refused() -> None:
    reassembler = ControlReassembler()
    join(reassembler, [beginning(SOURCE, 1, parts=3)])
    with pytest.raises(FrameError) as caught:
        join(reassembler, [beginning(SOURCE, 1, parts=4, part=1)])
    assert caught.value.reason is DropReason.BAD_PARTS


def test_more_parts_than_a_statement_has_cost_nothing() -> None:
    reassembler = ControlReassembler()
    with pytest.raises(FrameError) as caught:
        join(reassembler, [beginning(SOURCE, 1, parts=CONTROL_PARTS_MAX + 1)])
    assert caught.value.reason is DropReason.BAD_PARTS
    assert reassembler.held_bytes == 0


def test_a_statement_that_grows_above_the_limit_is_dropped_whole() -> None:
    reassembler = ControlReassembler()
    with pytest.raises(FrameError) as caught:
        join(reassembler, [beginning(SOURCE, 1, size=6_000, parts=9, part=part) for part in range(3)])
    assert caught.value.reason is DropReason.TOO_BIG
    assert reassembler.held_bytes == 0


def test_what_never_becomes_whole_is_given_back() -> None:
    reassembler = ControlReassembler()
    join(reassembler, [beginning(SOURCE, number) for number in range(10)])
    reassembler.drop_expired(CONTROL_PATIENCE_S)
    assert (reassembler.held_bytes, len(reassembler.unfinished)) == (0, 0)
    assert reassembler.drops[DropReason.ABANDONED] == 10


def test_a_flood_of_one_source_stays_within_its_bound() -> None:
    reassembler = ControlReassembler()
    for number in range(1_000):
        join(reassembler, [beginning(SOURCE, number)])
        assert reassembler.held_bytes <= CONTROL_JOIN_SOURCE_BYTES
    assert reassembler.drops[DropReason.MEMORY_FULL] > 900


def test_a_flood_of_many_sources_stays_within_the_whole_bound() -> None:
    reassembler = ControlReassembler()
    for number in range(3_000):
        join(reassembler, [beginning(number.to_bytes(32, "big"), 1)])
    assert CONTROL_JOIN_BYTES // 2 < reassembler.held_bytes <= CONTROL_JOIN_BYTES


@pytest.mark.parametrize("is_same_source", [True, False])
def test_a_statement_comes_through_a_flood(is_same_source: bool) -> None:
    reassembler = ControlReassembler()
    frames = fragmenter().split(Kind.HELLO, b"x" * 4_000, 1_500)
    for number in range(5_000):
        source = bytes(SOURCE) if is_same_source else number.to_bytes(32, "big")
        join(reassembler, [beginning(source, number + 10)])
        if number == 2_500:
            join(reassembler, frames[:1])
    assert reassembler.held_bytes <= CONTROL_JOIN_BYTES
    for number in range(5_000, 5_020):
        join(reassembler, [beginning(bytes(SOURCE), number + 10)])
    assert join(reassembler, fragmenter(8).split(Kind.HELLO, b"y" * 4_000, 1_500)) == b"y" * 4_000


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(1, 5), st.integers(0, 4)), max_size=60))
def test_whatever_comes_what_is_held_is_what_waits(frames: list[tuple[int, int, int, int]]) -> None:
    reassembler = ControlReassembler()
    for now_s, (source, number, parts, part) in enumerate(frames):
        if part < parts:
            frame = beginning(bytes([source]) * 32, number, 100, parts, part)
            try:
                reassembler.add(decode(frame), frame, now_s / 10)
            except FrameError as error:
                reassembler.drops[error.reason] += 1
    reassembler.drop_expired(1_000.0)
    assert (reassembler.held_bytes, dict(reassembler.unfinished)) == (0, {})


def test_padding_behind_the_payload_is_cut_off() -> None:
    frame = fragmenter().split(Kind.HELLO, b"short", 1_500)[0]
    assert len(frame) == HEADER_BYTES + 5
    assert ControlReassembler().add(decode(frame), frame + bytes(20), 0.0) == b"short"


def test_parts_from_another_address_do_not_spoil_a_statement() -> None:
    to = ControlReassembler()
    first, second = ControlFragmenter(b"s" * 32, 1).split(Kind.HELLO, b"x" * 700, 576)
    spoilt = first[:HEADER_BYTES] + bytes(len(first) - HEADER_BYTES)
    assert to.add(decode(spoilt), spoilt, 0.0, b"stranger") is None
    assert to.add(decode(first), first, 0.0, b"neighbour") is None
    assert to.add(decode(second), second, 0.0, b"neighbour") == b"x" * 700
