"""Requests at the server's side: each reaches the local server once, in order, and never after it was cancelled."""

from __future__ import annotations

from gdp.names import Name
from gdp.service.serving import ANSWER_KEPT_BYTES, Asked, Expired, Serving

CLIENT = Name(bytes(32))


def asked(call: int) -> Asked:
    return Asked(CLIENT, 0, call)


def begun(serving: Serving[str], *calls: int) -> list[int]:
    return [serving.begin(0.0, 5.0, asked(call), f"request {call}") for call in calls]


def given(serving: Serving[str]) -> list[str]:
    return [turn.request for turn in serving.poll_turns(0.0)]


def test_without_a_limit_all_are_given_at_once_and_each_once() -> None:
    serving: Serving[str] = Serving(7)
    begun(serving, 1, 2, 3)
    assert given(serving) == ["request 1", "request 2", "request 3"]
    assert given(serving) == []


def test_with_a_limit_the_next_is_given_when_one_is_done() -> None:
    serving: Serving[str] = Serving(7, at_once=1)
    first, *_ = begun(serving, 1, 2)
    assert given(serving) == ["request 1"]
    assert (serving.end(first), given(serving)) == (asked(1), ["request 2"])


def test_a_stopped_call_that_waits_is_never_given() -> None:
    serving: Serving[str] = Serving(7, at_once=1)
    first, *_ = begun(serving, 1, 2, 3)
    assert given(serving) == ["request 1"]
    assert serving.stop(asked(2)) is None
    serving.end(first)
    assert given(serving) == ["request 3"]


def test_a_stopped_call_keeps_its_place_until_the_server_is_done_with_it() -> None:
    serving: Serving[str] = Serving(7, at_once=1)
    first, *_ = begun(serving, 1, 2)
    assert given(serving) == ["request 1"]
    assert (serving.stop(asked(1)), given(serving)) == (first, [])
    assert (serving.end(first), given(serving)) == (None, ["request 2"])


def test_what_a_client_that_left_waits_for_is_never_given_and_what_the_server_has_keeps_its_place() -> None:
    serving: Serving[str] = Serving(7, at_once=1)
    first, second = begun(serving, 1, 2)
    other = Asked(Name(bytes([1]) * 32), 0, 1)
    serving.begin(0.0, 5.0, other, "other")
    assert given(serving) == ["request 1"]
    assert serving.remove_client(CLIENT) == [Expired(first, 0, asked(1), True), Expired(second, 0, asked(2), False)]
    assert (given(serving), serving.remove_client(CLIENT)) == ([], [])
    assert (serving.end(first), given(serving), serving.clients) == (None, ["other"], [other.client])


def test_a_client_that_left_and_comes_back_may_ask_the_same_again() -> None:
    serving: Serving[str] = Serving(7)
    (first,) = begun(serving, 1)
    serving.poll_turns(0.0)
    serving.remove_client(CLIENT)
    assert (len(serving), serving.end(first), asked(1) in serving) == (0, None, False)
    assert serving.answer_of(asked(1)) is None
    begun(serving, 1)
    assert given(serving) == ["request 1"]


def test_without_a_limit_a_stopped_call_is_forgotten_at_once() -> None:
    serving: Serving[str] = Serving(7)
    (first,) = begun(serving, 1)
    serving.poll_turns(0.0)
    assert (serving.stop(asked(1)), len(serving), serving.end(first)) == (first, 0, None)


def test_a_stop_that_overtakes_its_request_is_remembered() -> None:
    serving: Serving[str] = Serving(7)
    serving.stop(asked(1))
    assert serving.answer_of(asked(1)) == b""


def test_an_answer_is_kept_for_a_request_that_comes_again_unless_it_is_large() -> None:
    serving: Serving[str] = Serving(7)
    serving.remember(asked(1), b"answer")
    serving.stop(asked(1))  # in time for others
    serving.remember(asked(2), bytes(ANSWER_KEPT_BYTES + 1))
    assert [serving.answer_of(asked(call)) for call in (1, 2, 3)] == [b"answer", None, None]


def test_what_took_too_long_frees_its_place() -> None:
    serving: Serving[str] = Serving(7, at_once=1)
    first, *_ = begun(serving, 1)
    serving.begin(1.0, None, asked(2), "request 2")
    serving.poll_turns(0.0)
    assert serving.get_timer() == 5.0
    assert (serving.expired(5.0), given(serving)) == ([Expired(first, 0, asked(1), True)], ["request 2"])


def test_what_waits_for_another_is_given_when_that_has_ended_however_it_ends() -> None:
    for end in (Serving.end, lambda serving, _: serving.expired(5.0), lambda serving, _: serving.stop(asked(1))):
        serving: Serving[str] = Serving(7)
        (first,) = begun(serving, 1)
        serving.begin(0.0, None, asked(2), "result", after=asked(1))
        assert given(serving) == ["request 1"]
        end(serving, first)
        assert given(serving) == ["result"]


def test_all_fail_except_those_without_a_waiting_client() -> None:
    serving: Serving[str] = Serving(7, at_once=1)
    begun(serving, 1, 2)
    serving.poll_turns(0.0)
    serving.stop(asked(1))
    assert (serving.fail_all(), len(serving), given(serving)) == ([asked(2)], 0, [])
