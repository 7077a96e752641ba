"""Reassembly of fragments: any input, in any order, within bounds."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.burst.cipher import TAG_BYTES
from gdp.errors import DropReason, FrameError
from gdp.frame.codec import HEADER_BYTES, HOPS_AT, Flag, Header, Kind, decode, encode
from gdp.limits import HOPS_MAX, JOIN_MESSAGES_MAX, JOIN_PATIENCE_S
from gdp.message.reassembly import ALL_PARTS
from gdp.message.reassembly_quota import ReassemblyQuota
from tests.gdp.message.sealed import INCARNATION, MTU, OTHER, SOURCE, TOPIC, add, add_all, reassembler, seal

LONG = bytes(range(256)) * 8


@given(st.integers(0, 3_000), st.integers(0, 1 << 32), st.booleans())
def test_a_message_is_whole_whatever_the_order_of_its_parts(size: int, seed: int, doubled: bool) -> None:
    message = Random(seed).randbytes(size)
    frames = seal(1, message)
    arriving = frames * 2 if doubled else frames
    Random(seed).shuffle(arriving)
    budget = ReassemblyQuota()
    joined = add_all(reassembler(budget), arriving)
    assert [each.message for each in joined] == [message]
    assert joined[0].parts == len(frames)
    assert budget.held_bytes == 0


def test_messages_whose_parts_are_interleaved_are_kept_apart() -> None:
    messages = {number: bytes([number]) * 900 for number in range(1, 20)}
    frames = [frame for number, message in messages.items() for frame in seal(number, message)]
    Random(3).shuffle(frames)
    joined = add_all(reassembler(), frames)
    assert {each.number: each.message for each in joined} == messages


def test_a_late_part_of_a_finished_message_is_dropped() -> None:
    to, frames = reassembler(), seal(1, LONG)
    add_all(to, frames)
    assert add_all(to, frames) == []
    assert to.drops == {DropReason.LATE: len(frames)}


def test_a_part_that_comes_twice_is_dropped() -> None:
    to, frames = reassembler(), seal(1, LONG)
    add_all(to, [frames[0], frames[0]])
    assert to.drops == {DropReason.DUPLICATE: 1}


@pytest.mark.parametrize(
    ("parts", "flags", "is_copy"),
    [(1, Flag.URGENT, True), (2, Flag.URGENT, True), (3, Flag.URGENT, False), (1, 0, False), (2, 0, False)],
)
def test_urgent_messages_of_up_to_two_parts_have_copies_and_others_do_not(
    parts: int, flags: int, is_copy: bool
) -> None:
    to, frames = reassembler(), seal(1, bytes(188 * (parts - 1)), flags=flags)
    assert len(frames) == parts
    for frame in frames:
        add(to, frame)
        add(to, frame, 0.004)
    assert to.drops[DropReason.SECOND_COPY] == (parts if is_copy else 0)
    assert to.drops.total() == parts


@pytest.mark.parametrize("parts", [0, (1 << 17) + 1, 0xFFFF_FFFF])
def test_an_impossible_count_of_parts_is_refused_before_the_reassembler(parts: int) -> None:
    header = Header(Kind.DATA, 0, HOPS_MAX, 1, TAG_BYTES, 1, 0, parts, INCARNATION, TOPIC, SOURCE)
    with pytest.raises(FrameError) as caught:
        decode(encode(header) + bytes(TAG_BYTES))
    assert caught.value.reason is DropReason.BAD_PARTS


def test_a_huge_count_of_parts_costs_only_the_parts_that_came() -> None:
    budget = ReassemblyQuota()
    to = reassembler(budget)
    frame = seal(1, bytes(188 * 100_000))[70_000]
    add(to, frame)
    assert 0 < budget.held_bytes < 1_000
    assert to.missing(1, 5, to_end=True) == [(0, 4_095)]


def test_of_two_counts_of_parts_the_later_one_holds() -> None:
    to, forged, real = reassembler(), seal(1, bytes(2_000), signer=OTHER), seal(1, LONG[:500])
    add_all(to, forged[:2])
    joined = add_all(to, real)
    assert [each.message for each in joined] == [LONG[:500]]
    assert to.drops == {DropReason.BAD_PARTS: 1}


def test_a_whole_message_outdoes_a_forged_beginning_of_many_parts() -> None:
    budget = ReassemblyQuota()
    to = reassembler(budget)
    add(to, seal(1, LONG, signer=OTHER)[0])
    assert [each.message for each in add_all(to, seal(1, b"short"))] == [b"short"]
    assert budget.held_bytes == 0


def test_a_bad_signature_leaves_the_writers_own_message_joinable() -> None:
    for message in (LONG, b"short"):
        to = reassembler()
        assert add_all(to, seal(1, message, signer=OTHER)) == []
        assert to.drops == {DropReason.BAD_SIGNATURE: 1}
        assert [each.message for each in add_all(to, seal(1, message))] == [message]


@given(st.integers(0, 1 << 32), st.integers(0, 255), st.integers(1, 255))
def test_an_altered_part_costs_no_memory_and_harms_nothing(seed: int, at: int, change: int) -> None:
    budget = ReassemblyQuota()
    to, frames = reassembler(budget), seal(1, LONG)
    altered = bytearray(frames[1])
    at = at % len(altered)
    altered[at] ^= change
    try:
        header = decode(altered)
    except FrameError:
        return
    assert to.add(header, bytes(altered), 0.0) is None
    if at == HOPS_AT:
        assert to.drops == {}
    else:
        assert budget.held_bytes == 0
        assert sum(to.drops.values()) == 1
    assert [each.message for each in add_all(to, frames)] == [LONG]


@given(st.binary(max_size=300), st.booleans())
def test_arbitrary_bytes_are_dropped_and_cost_nothing(payload: bytes, is_framed: bool) -> None:
    budget = ReassemblyQuota()
    to = reassembler(budget)
    if is_framed:
        header = Header(Kind.DATA, Flag.LAST, 1, 1, len(payload), 3, 0, 1, INCARNATION, TOPIC, SOURCE)
        payload = encode(header) + payload
    try:
        read = decode(payload)
    except FrameError:
        return
    assert to.add(read, payload, 0.0) is None
    assert budget.held_bytes == 0


def test_an_unknown_epoch_is_counted() -> None:
    to, (frame,) = reassembler(), seal(1, b"x")
    header = decode(frame)._replace(epoch=7)
    assert to.add(header, encode(header) + frame[HEADER_BYTES:], 0.0) is None
    assert to.drops == {DropReason.UNKNOWN_EPOCH: 1}


def test_what_waits_too_long_is_given_back_and_stays_finished() -> None:
    budget = ReassemblyQuota()
    to, frames = reassembler(budget), seal(1, LONG)
    add_all(to, frames[:-1], 10.0)
    assert to.next_expiry() == 10.0 + JOIN_PATIENCE_S
    assert to.drop_expired(10.0 + JOIN_PATIENCE_S - 0.1) == 0
    assert to.drop_expired(10.0 + JOIN_PATIENCE_S) == 1
    assert budget.held_bytes == 0
    assert add(to, frames[-1], 16.0) is None
    assert to.drops == {DropReason.ABANDONED: 1, DropReason.LATE: 1}


def test_what_is_given_back_but_not_for_good_may_begin_again() -> None:
    to, frames = reassembler(), seal(1, LONG)
    add_all(to, frames[:-1], 10.0)
    assert to.drop_expired(20.0, for_good=False) == 1
    assert [each.message for each in add_all(to, frames, 20.0)] == [LONG]


def test_memory_is_bounded_for_a_source_and_given_back() -> None:
    budget = ReassemblyQuota(100_000, 20_000)
    to = reassembler(budget)
    for number in range(1, 100):
        add_all(to, seal(number, LONG)[:-1])
        assert budget.held_bytes <= 20_000
    assert to.drops[DropReason.MEMORY_FULL] > 0
    to.close()
    assert budget.held_bytes == 0


def test_memory_is_bounded_for_all_sources_together() -> None:
    budget = ReassemblyQuota(5_000, 5_000)
    assert budget.reserve(b"another", 4_000)
    to = reassembler(budget)
    add_all(to, seal(1, LONG)[:-1])
    assert budget.held_bytes <= 5_000
    assert to.drops[DropReason.MEMORY_FULL] > 0


def test_a_message_that_is_needed_sooner_takes_the_memory_of_a_later_one() -> None:
    budget = ReassemblyQuota(20_000, 20_000)
    to = reassembler(budget)
    for number in range(50, 80):
        add_all(to, seal(number, LONG, signer=OTHER)[:-1])
    assert [each.message for each in add_all(to, seal(1, LONG))] == [LONG]
    assert to.drops[DropReason.ABANDONED] > 0


def test_more_unfinished_messages_than_allowed_leave_space_for_the_next_one_needed() -> None:
    to = reassembler()
    for number in range(10, 10 + JOIN_MESSAGES_MAX + 5):
        add(to, seal(number, bytes(200))[0])
    assert to.drops == {DropReason.MEMORY_FULL: 5}
    assert [each.message for each in add_all(to, seal(1, LONG))] == [LONG]
    assert to.drops[DropReason.ABANDONED] == 1


def test_the_gaps_of_a_message_are_reported_as_ranges() -> None:
    to, frames = reassembler(), seal(5, LONG)
    assert len(frames) == 12
    add_all(to, [frames[0], frames[1], frames[4], frames[6], frames[7]])
    assert to.missing(5, 10) == [(2, 3), (5, 5)]
    assert to.missing(5, 10, to_end=True) == [(2, 3), (5, 5), (8, 11)]
    assert to.missing(5, 1, to_end=True) == [(2, 3)]
    assert to.progress(5) == 2


def test_of_a_message_never_seen_everything_is_missing_once_a_later_one_came() -> None:
    to = reassembler()
    add_all(to, seal(5, b"x"))
    assert to.missing(4, 10) == [(0, ALL_PARTS)]
    assert to.missing(6, 10) == []
    assert to.missing(6, 10, to_end=True) == [(0, ALL_PARTS)]
    assert to.missing(5, 10, to_end=True) == []


@given(st.sets(st.integers(0, 11), max_size=11), st.booleans())
def test_what_is_held_and_what_is_missing_make_up_the_message(held: set[int], to_end: bool) -> None:
    to, frames = reassembler(), seal(5, LONG)
    add_all(to, [frames[part] for part in sorted(held)])
    ranges = to.missing(5, 100, to_end=to_end)
    missing = {part for first, last in ranges for part in range(first, min(last, 11) + 1)}
    everything = set(range(12)) if to_end else set(range(max(held, default=-1) + 1))
    assert missing == everything - held


def test_the_longest_path_of_a_fragment_is_reported() -> None:
    to, frames = reassembler(), seal(1, bytes(300), mtu=MTU)
    hops = [bytearray(frame) for frame in frames]
    hops[1][HOPS_AT] = HOPS_MAX - 5
    (joined,) = add_all(to, [bytes(frame) for frame in hops])
    assert joined.hops == 5


def test_what_was_believed_before_the_beginning_is_forgotten_there() -> None:
    budget = ReassemblyQuota()
    to = reassembler(budget)
    add_all(to, seal(20, LONG)[:3])
    add_all(to, seal(3, LONG)[:3])
    add_all(to, seal(1 << 63, b"signed, but absurd"))
    to.start_at(10, [])
    assert not to.is_finished(10)
    assert to.highest == 20
    assert to.missing(20, 10, to_end=True) == [(3, 11)]
    assert to.missing(3, 10) == [(0, ALL_PARTS)]
