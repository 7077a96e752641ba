"""Calls in flight: each ends exactly once, with any events in any order."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.service.calls import Calls


def test_the_first_response_wins_and_a_later_one_finds_no_call() -> None:
    calls: Calls[str] = Calls(4, 7)
    number = calls.add_call(0.0, 5.0, "first")
    assert [calls.get(number), calls.end(number), calls.end(number)] == ["first", "first", None]


def test_an_answer_after_the_timeout_never_answers_the_next_call() -> None:
    calls: Calls[str] = Calls(4, 7)
    late = calls.add_call(0.0, 1.0, "late")
    assert calls.expired(1.0) == [(late, "late")]
    calls.add_call(1.0, 1.0, "next")
    assert (calls.end(late), len(calls)) == (None, 1)


def test_numbers_begin_at_the_random_start_and_wrap_in_64_bits() -> None:
    calls: Calls[str] = Calls(4, (1 << 64) - 1)
    assert [calls.add_call(0.0, None, "a"), calls.add_call(0.0, None, "b")] == [(1 << 64) - 1, 0]


def test_a_call_without_a_timeout_waits_for_ever() -> None:
    calls: Calls[str] = Calls(4, 7)
    number = calls.add_call(0.0, None, "goal")
    assert (calls.get_timer(), calls.expired(1e9), number in calls) == (None, [], True)


def test_calls_above_the_limit_are_refused_until_one_ends() -> None:
    calls: Calls[int] = Calls(2, 0)
    first = calls.add_call(0.0, 1.0, 1)
    calls.add_call(0.0, 1.0, 2)
    with pytest.raises(LocalError, match="2 calls"):
        calls.add_call(0.0, 1.0, 3)
    calls.end(first)
    calls.add_call(0.0, 1.0, 3)


def test_all_fail_at_once_the_oldest_first() -> None:
    calls: Calls[str] = Calls(4, 7)
    calls.add_call(0.0, 5.0, "a")
    calls.add_call(0.0, 1.0, "b")
    assert calls.fail_all() == [(7, "a"), (8, "b")]
    assert (len(calls), calls.get_timer(), calls.fail_all()) == (0, None, [])


Step = st.one_of(
    st.tuples(st.just("begin"), st.one_of(st.none(), st.integers(0, 5))),
    st.tuples(st.just("answer"), st.integers(0, 20)),
    st.tuples(st.just("wait"), st.integers(0, 3)),
    st.tuples(st.just("fail"), st.none()),
)


@given(st.lists(Step, max_size=60))
def test_each_call_ends_exactly_once_and_never_before_its_time(steps: list[tuple[str, int | None]]) -> None:
    calls: Calls[int] = Calls(8, 0)
    now_s, begun = 0.0, 0
    open_until: dict[int, float] = {}
    for step, value in steps:
        if step == "begin" and len(open_until) < 8:
            number = calls.add_call(now_s, value, begun)
            assert number == begun
            open_until[number] = float("inf") if value is None else now_s + value
            begun += 1
        elif step == "answer" and value is not None:
            assert (calls.end(value) is not None) == (open_until.pop(value, None) is not None)
        elif step == "wait" and value is not None:
            now_s += value
            due = {number for number, until_s in open_until.items() if until_s <= now_s}
            assert {number for number, _ in calls.expired(now_s)} == due
            open_until = {number: each for number, each in open_until.items() if number not in due}
        elif step == "fail":
            assert [number for number, _ in calls.fail_all()] == list(open_until)
            open_until.clear()
        ends = [until_s for until_s in open_until.values() if until_s != float("inf")]
        assert calls.get_timer() == min(ends, default=None)
        assert len(calls) == len(open_until)
