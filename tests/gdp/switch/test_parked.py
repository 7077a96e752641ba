"""Parked frames: in order, bounded in number, bytes and time, and counted when dropped."""

from __future__ import annotations

from gdp.errors import DropReason
from gdp.limits import PARKED_BYTES_MAX, PARKED_FRAMES_MAX, PARKED_S
from gdp.switch.parked import Parked

A, B = b"a" * 32, b"b" * 32


def test_what_waited_comes_out_in_order_and_once() -> None:
    parked = Parked()
    for frame in (b"1", b"2", b"3"):
        parked.park(A, frame, 0.0)
    assert [frame for frame, _, _ in parked.release(A)] == [b"1", b"2", b"3"]
    assert (parked.release(A), len(parked)) == ([], 0)


def test_names_do_not_mix() -> None:
    parked = Parked()
    parked.park(A, b"1", 0.0)
    parked.park(B, b"2", 0.0)
    assert [frame for frame, _, _ in parked.release(B)] == [b"2"]
    assert len(parked) == 1


def test_more_frames_than_fit_are_counted() -> None:
    parked = Parked()
    for _ in range(PARKED_FRAMES_MAX // 2 + 3):
        parked.park(A, b"x", 0.0, owner=b"greedy")
    assert (len(parked), parked.drops[DropReason.PARKED_FULL]) == (PARKED_FRAMES_MAX // 2, 3)
    parked.park(A, b"x", 0.0, owner=b"modest")
    assert parked.drops[DropReason.PARKED_FULL] == 3


def test_more_bytes_than_fit_are_counted_and_room_comes_back() -> None:
    parked = Parked()
    quarter = bytes(PARKED_BYTES_MAX // 4)
    for _ in range(3):
        parked.park(A, quarter, 0.0)
    assert parked.drops[DropReason.PARKED_FULL] == 1
    parked.release(A)
    parked.park(A, quarter, 0.0)
    assert len(parked) == 1


def test_what_waits_too_long_is_dropped_under_its_reason() -> None:
    parked = Parked()
    parked.park(A, b"1", 0.0)
    parked.park(A, b"2", 1.0)
    assert parked.next_expiry() == PARKED_S
    parked.expire(PARKED_S)
    assert parked.drops[DropReason.PARKED_EXPIRED] == 1
    assert [frame for frame, _, _ in parked.release(A)] == [b"2"]
    assert parked.next_expiry() is None


def test_what_is_refused_is_dropped_under_that_reason() -> None:
    parked = Parked()
    parked.park(A, b"1", 0.0)
    parked.refuse(A, DropReason.NO_ROUTE)
    assert (len(parked), parked.drops[DropReason.NO_ROUTE]) == (0, 1)
