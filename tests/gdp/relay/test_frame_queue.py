"""Bounded queue in front of a slow connection."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gdp.frame.codec import Flag, Kind
from gdp.relay.frame_queue import FrameQueue


def frame(number: int, flags: Flag = Flag.NONE, kind: Kind = Kind.DATA, size: int = 200) -> bytes:
    return bytes(12) + b"\x88\xb5" + bytes([1, kind, flags]) + number.to_bytes(4, "big") + bytes(size - 21)


def numbers(frames: list[bytes]) -> list[int]:
    return [int.from_bytes(each[17:21], "big") for each in frames]


def filled(*frames: bytes, limit_bytes: int = 1_010) -> FrameQueue:
    queue = FrameQueue(limit_bytes)  # five frames of 202 bytes with their prefix
    for each in frames:
        queue.put(each)
    return queue


def test_frames_leave_in_the_order_of_their_arrival() -> None:
    queue = filled(frame(1), frame(2, Flag.RELIABLE), frame(3), frame(4, Flag.RELIABLE))
    assert numbers(queue.take(10_000)) == [1, 2, 3, 4]


def test_urgent_frames_and_frames_of_neighbours_leave_first() -> None:
    queue = filled(frame(1), frame(2, Flag.URGENT), frame(3, kind=Kind.KEEPALIVE))
    assert numbers(queue.take(10_000)) == [2, 3, 1]


def test_a_full_queue_drops_its_oldest_best_effort_frames() -> None:
    queue = filled(*(frame(each) for each in range(7)))
    assert numbers(queue.take(10_000)) == [2, 3, 4, 5, 6]
    assert queue.dropped == 2


def test_a_full_queue_of_reliable_frames_drops_the_new_one() -> None:
    queue = filled(*(frame(each, Flag.RELIABLE) for each in range(7)))
    assert numbers(queue.take(10_000)) == [0, 1, 2, 3, 4]
    assert queue.dropped == 2


def test_a_budget_bounds_what_leaves_at_once() -> None:
    queue = filled(frame(1), frame(2), frame(3))
    assert numbers(queue.take(450)) == [1, 2]
    assert numbers(queue.take(1)) == [3], "at least one"
    assert queue.take(450) == []


def test_frames_of_an_ended_connection_count_as_dropped() -> None:
    queue = filled(frame(1), frame(2))
    queue.clear()
    assert (len(queue), queue.held_bytes, queue.dropped) == (0, 0, 2)


@given(
    st.lists(
        st.tuples(st.sampled_from([Flag.NONE, Flag.RELIABLE, Flag.URGENT]), st.integers(21, 900))
        | st.integers(1, 2_000),
        max_size=60,
    )
)
def test_the_queue_never_holds_more_than_its_limit_and_loses_no_count(steps: list[tuple[Flag, int] | int]) -> None:
    queue = FrameQueue(2_000)
    put = taken = 0
    for step in steps:
        if isinstance(step, int):
            taken += len(queue.take(step))
        else:
            put += 1
            queue.put(frame(put, step[0], size=step[1]))
        assert 0 <= queue.held_bytes <= 2_000
        assert put == taken + queue.dropped + len(queue)
    taken += len(queue.take(1 << 20))
    assert queue.held_bytes == 0
