"""Relation of calls in flight to goals."""

from __future__ import annotations

from gdp.names import Name
from gdp.service.serving import Asked
from proxy.bridge.cancellation import GoalCalls
from proxy.bridge.core.action_interface import GOAL, RESULT

ONE, TWO = (bytes([number]) * 16 for number in (1, 2))
A, B = (Name(bytes([number]) * 32) for number in (1, 2))


def test_a_goal_is_awaited_until_the_last_call_for_its_result_has_ended() -> None:
    calls = GoalCalls()
    waiting = [Asked(A, RESULT, 1), Asked(B, RESULT, 1)]
    for each in waiting:
        calls.add(each, ONE)
    assert (calls.is_awaited(ONE), calls.is_awaited(TWO), calls.accepting(ONE)) == (True, False, None)
    assert [(calls.end(each), calls.is_awaited(ONE)) for each in waiting] == [(ONE, True), (ONE, False)]
    assert (len(calls), calls.end(waiting[0])) == (0, None)


def test_a_goal_is_being_accepted_until_that_call_has_ended() -> None:
    calls, asked = GoalCalls(), Asked(A, GOAL, 1)
    calls.add(asked, ONE)
    assert (calls.accepting(ONE), calls.accepting(TWO), calls.is_awaited(ONE)) == (asked, None, False)
    calls.end(asked)
    assert calls.accepting(ONE) is None
