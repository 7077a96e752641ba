"""Accounts of a numbered flow, from the moments that it recorded."""

from __future__ import annotations

import pytest

from lab.internet.flow import NumberedFlow
from lab.process import FailedError, until


@pytest.fixture
def flow() -> NumberedFlow:
    """Return a flow of five messages, a second apart, of which number 1 came twice and number 3 never."""
    made = NumberedFlow.__new__(NumberedFlow)
    made.sent_s = [10.0, 11.0, 12.0, 13.0, 14.0]
    made.arrivals = [[(10.25, 0), (11.5, 1), (11.75, 1), (12.25, 2), (14.25, 4)]]
    return made


def test_a_message_that_never_came_is_lost_and_one_that_came_again_is_doubled(flow: NumberedFlow) -> None:
    assert (flow.lost, flow.doubled) == (1, 1)


def test_a_silence_includes_the_ends_of_its_interval(flow: NumberedFlow) -> None:
    assert flow.silence_ms(12.0, 14.5) == 2_000.0
    assert flow.silence_ms(14.5, 15.0) == 500.0


def test_a_wait_returns_what_it_finds_and_else_says_what_is_missing() -> None:
    found = iter([[], [7]])
    assert until(lambda: next(found), lambda: "a number", 5.0, lambda: None) == [7]
    with pytest.raises(FailedError, match=r"a number: not within 0 s"):
        until(lambda: False, lambda: "a number", 0.0)
