"""Replay window, compared with a plain set."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.message.replay import ReplayWindow

SIZE = 16


@pytest.mark.parametrize(
    ("finished", "asked", "expected"),
    [
        ([], 0, False),
        ([], (1 << 64) - 1, False),
        ([0], 0, True),
        ([5], 5, True),
        ([5], 4, False),
        ([5], 6, False),
        ([5, 3], 3, True),
        ([100], 100 - SIZE + 1, False),
        ([100], 100 - SIZE, True),
        ([100, 1 << 63], 100, True),
        ([1 << 63, 7], 7, True),
        ([100, 100 - SIZE + 1], 100 - SIZE + 1, True),
    ],
)
def test_what_was_finished_or_is_too_old_is_finished(finished: list[int], asked: int, expected: bool) -> None:
    window = ReplayWindow(SIZE)
    for number in finished:
        window.finish(number)
    assert window.is_finished(asked) is expected


def model_says(finished: list[int], number: int) -> bool:
    top = -1
    seen: set[int] = set()
    for each in finished:
        if each > top - SIZE:
            seen.add(each)
        top = max(top, each)
    return number <= top and (number in seen or number <= top - SIZE)


@given(st.lists(st.integers(0, 60), max_size=30), st.integers(0, 80))
def test_the_window_agrees_with_a_set(finished: list[int], asked: int) -> None:
    window = ReplayWindow(SIZE)
    for number in finished:
        window.finish(number)
    assert window.is_finished(asked) == model_says(finished, asked)


@given(st.lists(st.integers(0, 60), max_size=30), st.integers(0, 70), st.integers(0, 90))
def test_the_unfinished_numbers_are_those_that_are_not_finished(finished: list[int], begin: int, end: int) -> None:
    window = ReplayWindow(SIZE)
    for number in finished:
        window.finish(number)
    assert list(window.unfinished(begin, end)) == [n for n in range(begin, end) if not window.is_finished(n)]


def test_an_iteration_over_the_unfinished_costs_nothing_for_the_finished_between() -> None:
    window = ReplayWindow()
    window.finish(1 << 63)
    assert next(window.unfinished(1, (1 << 64) - 1)) == (1 << 63) - 16_383
