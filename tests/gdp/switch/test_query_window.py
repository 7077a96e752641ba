"""Query window: bounded in flight, round robin by owner."""

from __future__ import annotations

import pytest

from gdp.switch.query_window import QueryWindow
from tests.gdp.switch.net import name

A, B, C = name("a"), name("b"), name("c")


def test_a_full_window_is_not_ready_until_a_name_is_answered() -> None:
    window = QueryWindow(size=1)
    window.put(b"", A)
    window.put(b"", B)
    window.sent(window.pop())
    assert not window.is_ready
    window.answered(A)
    assert window.is_ready


def test_owners_take_turns_in_the_window() -> None:
    window = QueryWindow()
    window.put(b"greedy", A)
    window.put(b"greedy", B)
    window.put(b"modest", C)
    assert [window.pop(), window.pop(), window.pop()] == [A, C, B]


def test_a_cancelled_name_leaves_the_queue() -> None:
    window = QueryWindow()
    window.put(b"", A)
    window.cancel(b"", A)
    assert not window.is_ready
    with pytest.raises(KeyError):
        window.pop()


def test_a_name_in_flight_stays_in_flight_when_it_is_cancelled() -> None:
    window = QueryWindow(size=1)
    window.sent(A)
    window.cancel(b"", A)
    window.put(b"", B)
    assert not window.is_ready
