"""Pending frames: in order, bounded in number, bytes and time, and counted when dropped."""

from __future__ import annotations

from gdp.errors import DropReason
from gdp.limits import PENDING_BYTES_MAX, PENDING_FRAMES_MAX, PENDING_S
from gdp.switch.name_resolver import PendingFrames

A, B = b"a" * 32, b"b" * 32


def test_what_waited_comes_out_in_order_and_once() -> None:
    pending = PendingFrames()
    for frame in (b"1", b"2", b"3"):
        pending.park(A, frame, 0.0)
    assert [frame for frame, _, _ in pending.release(A)] == [b"1", b"2", b"3"]
    assert (pending.release(A), len(pending)) == ([], 0)


def test_names_do_not_mix() -> None:
    pending = PendingFrames()
    pending.park(A, b"1", 0.0)
    pending.park(B, b"2", 0.0)
    assert [frame for frame, _, _ in pending.release(B)] == [b"2"]
    assert len(pending) == 1


def test_more_frames_than_fit_are_counted() -> None:
    pending = PendingFrames()
    for _ in range(PENDING_FRAMES_MAX // 2 + 3):
        pending.park(A, b"x", 0.0, owner=b"greedy")
    assert (len(pending), pending.drops[DropReason.PENDING_FULL]) == (PENDING_FRAMES_MAX // 2, 3)
    pending.park(A, b"x", 0.0, owner=b"modest")
    assert pending.drops[DropReason.PENDING_FULL] == 3


def test_more_bytes_than_fit_are_counted_and_space_comes_back() -> None:
    pending = PendingFrames()
    quarter = bytes(PENDING_BYTES_MAX // 4)
    for _ in range(3):
        pending.park(A, quarter, 0.0)
    assert pending.drops[DropReason.PENDING_FULL] == 1
    pending.release(A)
    pending.park(A, quarter, 0.0)
    assert len(pending) == 1


def test_what_waits_too_long_is_dropped_under_its_reason() -> None:
    pending = PendingFrames()
    pending.park(A, b"1", 0.0)
    pending.park(A, b"2", 1.0)
    assert pending.next_expiry() == PENDING_S
    pending.expire(PENDING_S)
    assert pending.drops[DropReason.PENDING_EXPIRED] == 1
    assert [frame for frame, _, _ in pending.release(A)] == [b"2"]
    assert pending.next_expiry() is None


def test_what_is_refused_is_dropped_under_that_reason() -> None:
    pending = PendingFrames()
    pending.park(A, b"1", 0.0)
    pending.drop(A, DropReason.NO_ROUTE)
    assert (len(pending), pending.drops[DropReason.NO_ROUTE]) == (0, 1)
