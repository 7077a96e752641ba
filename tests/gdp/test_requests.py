"""Requests: repeated with growing pauses until they are answered, then renewed."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.requests import Backoff, Requests

PAUSES = Backoff(0.5, 3.0)


def sent_at(requests: Requests[str], backoff: Backoff, until_s: float, step_s: float = 0.125) -> list[float]:
    """Return when requests are sent until a second, at steps that fall on every pause."""
    times = []
    for count in range(int(until_s / step_s) + 1):
        for key in requests.poll_due(count * step_s):
            requests.sent(key, count * step_s, backoff)
            times.append(count * step_s)
    return times


def test_pauses_double_up_to_their_bound_however_many_tries() -> None:
    assert [PAUSES.pause_s(tries) for tries in (0, 1, 2, 3, 4, 5, 10**6)] == [0.5, 0.5, 1.0, 2.0, 3.0, 3.0, 3.0]


def test_the_first_pauses_may_be_equal() -> None:
    assert [Backoff(1.0, 9.0, equal=3).pause_s(tries) for tries in range(1, 8)] == [1, 1, 1, 2, 2, 2, 4]


def test_pauses_double_from_an_estimate_within_the_first_one_and_the_bound() -> None:
    assert [PAUSES.pause_s(tries, 1.25) for tries in (0, 1, 2, 3)] == [1.25, 1.25, 2.5, 3.0]
    assert [PAUSES.pause_s(1, estimate_s) for estimate_s in (0.1, 99.0)] == [0.5, 3.0]


def test_pauses_may_grow_a_few_times_only() -> None:
    assert [Backoff(1.0, 9.0, growing=2).pause_s(tries) for tries in range(1, 5)] == [1, 2, 9, 9]


@given(st.integers(0, 2**40), st.floats(0, 1, exclude_max=True))
def test_a_random_pause_is_between_half_of_the_pause_and_all_of_it(tries: int, chance: float) -> None:
    assert PAUSES.pause_s(tries) / 2 <= PAUSES.random_pause_s(tries, chance) <= PAUSES.pause_s(tries)


def test_a_request_is_repeated_until_it_is_answered() -> None:
    requests = Requests[str]()
    requests.start("a", 0.0)
    assert sent_at(requests, PAUSES, 8.0) == [0.0, 0.5, 1.5, 3.5, 6.5]
    assert (requests.tries("a"), requests.is_open("a")) == (5, True)
    requests.answered("a")
    assert (requests.tries("a"), requests.is_open("a"), requests.next_due()) == (0, False, None)


def test_a_renewal_begins_with_the_first_pause() -> None:
    requests = Requests[str]()
    requests.start("a", 0.0)
    sent_at(requests, PAUSES, 2.0)
    requests.answered("a", 4.0)
    assert sent_at(requests, PAUSES, 6.0) == [4.0, 4.5, 5.5]


def test_an_answer_that_nothing_asked_for_renews_nothing() -> None:
    requests = Requests[str]()
    requests.start("a", 0.0)
    sent_at(requests, PAUSES, 0.0)
    requests.answered("a", 4.0)
    requests.answered("a", 9.0)
    assert requests.next_due() == 4.0


def test_another_responder_gets_every_request_at_once_and_repeated_like_new_ones() -> None:
    requests = Requests[str]()
    for key in "abc":
        requests.start(key, 0.0)
    requests.start("waits for a window", float("inf"))
    sent_at(requests, PAUSES, 3.0)
    requests.answered("b", 60.0)
    requests.start_all(3.0)
    assert requests.poll_due(3.0) == ["a", "b", "c"]
    requests.sent("a", 3.0, PAUSES)
    assert requests.due_s("a") == 3.5
    assert not requests.is_open("b")


def test_a_request_can_be_due_sooner_and_never_later_by_haste() -> None:
    requests = Requests[str]()
    requests.start("a", 5.0)
    requests.hasten("a", 7.0)
    assert requests.next_due() == 5.0
    requests.hasten("a", 2.0)
    assert requests.next_due() == 2.0
    requests.hasten("unknown", 1.0)
    assert "unknown" not in requests


@pytest.mark.parametrize("is_sorted", [False, True])
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(["start", "answered", "cancel", "start_all", "poll"]), st.integers(0, 5)), max_size=60
    )
)
def test_nothing_is_sent_that_is_cancelled_or_not_due_and_nothing_open_is_forgotten(
    *, is_sorted: bool, steps: list[tuple[str, int]]
) -> None:
    requests, now_s = Requests[int](is_sorted=is_sorted), 0.0
    due_s: dict[int, float] = {}
    for step, key in steps:
        now_s += 0.25
        if step == "start":
            requests.start(key, now_s)
            due_s[key] = now_s
        elif step == "cancel":
            requests.cancel(key)
            due_s.pop(key, None)
        elif step == "start_all":
            requests.start_all(now_s)
            due_s = dict.fromkeys(due_s, now_s)
        elif step == "answered" and requests.is_open(key):
            requests.answered(key, now_s + 10.0)
            due_s[key] = now_s + 10.0
        elif step == "poll":
            found = requests.poll_due(now_s)
            assert set(found) == {each for each, at_s in due_s.items() if at_s <= now_s}
            for each in found:
                requests.sent(each, now_s, PAUSES)
                due_s[each] = now_s + PAUSES.pause_s(requests.tries(each))
        assert requests.next_due() == min(due_s.values(), default=None)
        assert len(requests) == len(due_s)
