"""Copies at their reader: the measured lag of the slower path, copies of urgent frames, and requests that wait."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.limits import SENDS_MAX
from gdp.message.acknack import MissingRange
from gdp.message.second_copies import DeferredRequests, RepeatedFrames, SecondCopies


def copies(lag_s: float, count: int = 20, begin_s: float = 0.0) -> SecondCopies:
    """Return the state after messages every 10 ms, each with a copy that came ``lag_s`` later."""
    made = SecondCopies()
    events = [(begin_s + n * 0.01, n, made.handle_first) for n in range(count)]
    events += [(at_s + lag_s, n, made.handle_copy) for at_s, n, _ in events]
    for at_s, number, handle in sorted(events, key=lambda event: event[:2]):
        handle(number, 0, at_s)
    return made


@given(st.floats(0.0001, 0.4))
def test_the_wait_is_longer_than_the_lag_that_was_measured(lag_s: float) -> None:
    assert lag_s < copies(lag_s).lag_s() < 2 * lag_s


def test_nothing_is_awaited_before_the_first_copy() -> None:
    made = SecondCopies()
    made.handle_first(1, 0, 5.0)
    assert made.lag_s() == 0


def test_nothing_is_awaited_from_a_path_that_brings_nothing() -> None:
    made = copies(0.02)
    for number in range(100, 220):
        made.handle_first(number, 0, number * 0.01)
    assert made.lag_s() == 0
    made.handle_copy(219, 0, 2.2)
    assert made.lag_s() > 0


def test_a_pause_of_the_writer_says_nothing_of_its_paths() -> None:
    made = copies(0.02)
    made.handle_first(1_000, 0, 60.0)
    assert made.lag_s() > 0.02


def test_only_the_copy_of_the_fragment_that_came_first_is_measured() -> None:
    made = SecondCopies()
    made.handle_first(1, 3, 0.0)
    made.handle_first(1, 4, 0.1)
    made.handle_copy(1, 4, 0.4)
    assert made.lag_s() == 0
    made.handle_copy(1, 3, 0.4)
    assert made.lag_s() == pytest.approx(0.5)


GAP = MissingRange(7, 2, 4)


def test_without_a_slower_path_everything_is_requested_at_once() -> None:
    assert DeferredRequests().poll_due((GAP,), 0.0, 1.0) == (GAP,)


def test_a_request_waits_for_the_slower_path() -> None:
    deferred = DeferredRequests()
    assert deferred.poll_due((GAP,), 0.1, 1.0) == ()
    assert deferred.due_s == pytest.approx(1.1)
    assert deferred.poll_due((GAP,), 0.1, 1.05) == ()
    assert deferred.due_s == pytest.approx(1.1)
    assert deferred.poll_due((GAP,), 0.1, 1.11) == (GAP,)


def test_only_what_is_still_missing_is_requested() -> None:
    deferred = DeferredRequests()
    deferred.poll_due((GAP, MissingRange(8, 0, 0)), 0.1, 1.0)
    assert deferred.poll_due((MissingRange(7, 3, 9), MissingRange(9, 0, 0)), 0.1, 1.2) == (MissingRange(7, 3, 4),)


def test_what_came_meanwhile_is_not_requested() -> None:
    deferred = DeferredRequests()
    deferred.poll_due((GAP,), 0.1, 1.0)
    assert deferred.poll_due((), 0.1, 1.2) == ()
    assert deferred.due_s == float("inf")


def test_as_many_copies_are_expected_as_a_publisher_may_send() -> None:
    made = RepeatedFrames()
    made.handle_first(7, 0, 1.0)
    taken = [made.handle_copy(7, 0, 1.0 + 0.004 * each) for each in range(1, 6)]
    assert taken == [True] * (SENDS_MAX - 1) + [False] * (6 - SENDS_MAX)
    assert made.copies == SENDS_MAX - 1


def test_a_late_copy_is_none() -> None:
    made = RepeatedFrames()
    made.handle_first(7, 0, 1.0)
    assert not made.handle_copy(7, 0, 1.3)


def test_a_copy_of_what_never_came_is_none() -> None:
    assert not RepeatedFrames().handle_copy(7, 0, 1.0)


def test_a_reader_waits_for_longer_than_the_last_copy_took() -> None:
    made = RepeatedFrames()
    for number in range(20):
        made.handle_first(number, 0, number * 0.02)
        made.handle_copy(number, 0, number * 0.02 + 0.004)
        made.handle_copy(number, 0, number * 0.02 + 0.007)
    assert 0.007 < made.lag_s() < 0.01


def test_nothing_is_awaited_while_no_copies_come() -> None:
    made = RepeatedFrames()
    made.handle_first(0, 0, 0.0)
    assert made.lag_s() == 0.0
    made.handle_copy(0, 0, 0.004)
    assert made.lag_s() == pytest.approx(0.005)
    for number in range(1, 100):
        made.handle_first(number, 0, number * 0.02)
    assert made.lag_s() == 0.0
