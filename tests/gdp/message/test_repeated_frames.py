"""Copies of urgent frames at their reader."""

from __future__ import annotations

import pytest

from gdp.limits import SENDS_MAX
from gdp.message.repeated_frames import RepeatedFrames


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
