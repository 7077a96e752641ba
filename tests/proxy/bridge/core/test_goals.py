"""Choice of the server that reports a goal on which several servers work."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import RemoteError
from gdp.names import Name
from proxy.bridge.core.action_interface import CANCEL, GOAL, RESULT
from proxy.bridge.core.goals import GOAL_KEPT_MAX_BYTES, HEARTBEATS_MAX, Goals, cancel_of, goal_of, says_yes

CDR = b"\0\1\0\0"
A, B = (Name(bytes([number]) * 32) for number in (1, 2))
ONE, TWO = (bytes([number]) * 16 for number in (1, 2))
EXECUTING, SUCCEEDED, CANCELED = 2, 4, 5


def statuses(*goals: tuple[bytes, int], order: str = "<") -> bytes:
    """Return an ``action_msgs/GoalStatusArray``, the first goal's stamp being 1 s, the next one's 2 s, ..."""
    body = struct.pack(f"{order}I", len(goals))
    for number, (goal, status) in enumerate(goals, 1):
        body += goal
        body += bytes(-len(body) % 4) + struct.pack(f"{order}iIB", number, 0, status)
    return (CDR if order == "<" else bytes(4)) + body


def feedback(goal: bytes) -> bytes:
    return CDR + goal + b"feedback"


def test_feedback_comes_from_the_one_whose_acceptance_the_client_got() -> None:
    goals = Goals()
    goals.sent(ONE, b"goal")
    goals.accepted(ONE, B)
    assert [goals.may_feed(server, feedback(ONE)) for server in (A, B, A)] == [False, True, False]


def test_when_that_one_goes_the_next_who_speaks_takes_over() -> None:
    goals = Goals()
    goals.accepted(ONE, A)
    goals.remove_server(A)
    assert [goals.may_feed(server, feedback(ONE)) for server in (B, A)] == [True, False]


def test_a_goal_of_another_machines_client_has_one_speaker_too() -> None:
    goals = Goals()
    assert [goals.may_feed(server, feedback(ONE)) for server in (B, A, B)] == [True, False, True]


def test_goal_statuses_of_several_servers_come_as_one_message_each_goal_by_its_speaker() -> None:
    goals = Goals()
    goals.accepted(ONE, A)
    goals.accepted(TWO, B)
    assert goals.statuses(A, statuses((ONE, 1), (TWO, 1))) == statuses((ONE, 1))
    assert goals.statuses(B, statuses((ONE, EXECUTING))) is None
    said = goals.statuses(B, statuses((ONE, EXECUTING), (TWO, EXECUTING), order=">"))
    assert said == statuses((ONE, 1), (TWO, EXECUTING))
    stamp_and_status = struct.pack("<iIB", 2, 0, EXECUTING)
    assert goals.statuses(A, statuses()) == statuses((TWO, 0))[:24] + stamp_and_status


def test_what_a_server_said_that_is_gone_ends_when_another_speaks_and_does_not_know_the_goal() -> None:
    goals = Goals()
    goals.statuses(A, statuses((ONE, EXECUTING)))
    goals.remove_server(A)
    assert goals.statuses(B, statuses()) == statuses()


def test_nothing_contradicts_the_result_that_the_client_got() -> None:
    goals = Goals()
    goals.accepted(ONE, A)
    goals.statuses(A, statuses((ONE, EXECUTING)))
    assert goals.ended(ONE, B, CDR + bytes([SUCCEEDED])) == statuses((ONE, SUCCEEDED))
    assert goals.statuses(A, statuses((ONE, CANCELED))) is None
    assert goals.statuses(B, statuses((ONE, EXECUTING))) is None
    goals.remove_server(B)
    assert goals.statuses(A, statuses((ONE, CANCELED))) is None


def test_a_goal_is_sent_again_until_it_ends_or_is_cancelled() -> None:
    goals = Goals()
    for goal in (ONE, TWO):
        goals.sent(goal, b"goal")
        goals.holds(goal, {A})
    assert (goals.again(ONE), goals.holders(ONE)) == (b"goal", {A})
    goals.ended(ONE, A, CDR + bytes([SUCCEEDED]))
    goals.cancelled(bytes(16))  # all
    goals.remove_server(A)
    assert (goals.again(ONE), goals.again(TWO), goals.holders(TWO), goals.again(bytes(16))) == (None, None, set(), None)
    goals.sent(ONE, bytes(GOAL_KEPT_MAX_BYTES + 1))
    assert goals.again(ONE) is None


def test_goals_are_forgotten_the_oldest_first() -> None:
    goals = Goals()
    for number in range(2_000):
        goals.sent(number.to_bytes(16, "big"), b"goal")
    assert (goals.again(bytes(16)), goals.again((1_999).to_bytes(16, "big"))) == (None, b"goal")


def test_goals_that_one_server_names_push_out_no_goal_of_a_client_here_nor_another_servers() -> None:
    goals = Goals()
    goals.sent(ONE, b"goal")
    goals.may_feed(B, feedback(TWO))
    for first in range(0, 3_000, 1_000):
        many = [(number.to_bytes(16, "big"), EXECUTING) for number in range(1 << 40, (1 << 40) + 1_000)]
        goals.statuses(A, statuses(*((bytes([first // 1_000]) + goal[1:], status) for goal, status in many)))
    assert goals.again(ONE) == b"goal"
    assert [goals.may_feed(server, feedback(TWO)) for server in (A, B)] == [False, True]
    assert len(goals.statuses(B, statuses((TWO, EXECUTING))) or b"") < 40 * 1_100


def test_a_goal_that_a_server_named_first_is_kept_like_any_other_when_a_client_here_sends_it() -> None:
    goals = Goals()
    goals.may_feed(A, feedback(ONE))
    goals.sent(ONE, b"goal")
    goals.statuses(A, statuses(*((number.to_bytes(16, "big"), EXECUTING) for number in range(1_100))))
    assert goals.again(ONE) == b"goal"


def test_of_too_many_goals_of_clients_here_one_that_has_ended_goes_first() -> None:
    goals = Goals()
    for number in range(1_024):
        goals.sent(number.to_bytes(16, "big"), b"goal")
    ended = (7).to_bytes(16, "big")
    goals.holds(ended, {A})
    goals.ended(ended, A, CDR + bytes([SUCCEEDED]))
    goals.sent(ONE, b"goal")
    assert (goals.again(bytes(16)), goals.again(ONE), goals.holders(ended)) == (b"goal", b"goal", set())


def test_a_status_message_of_too_many_goals_is_refused() -> None:
    raw = statuses(*((number.to_bytes(16, "big"), EXECUTING) for number in range(HEARTBEATS_MAX + 1)))
    with pytest.raises(RemoteError, match="at most"):
        Goals().statuses(A, raw)


@pytest.mark.parametrize(
    ("part", "byte", "yes"),
    [(GOAL, 1, True), (GOAL, 0, False), (CANCEL, 0, True), (CANCEL, 2, False), (RESULT, 4, True), (RESULT, 0, False)],
)
def test_an_answer_says_yes_or_no_in_its_first_byte(part: int, byte: int, yes: bool) -> None:
    assert says_yes(part, CDR + bytes([byte])) is yes


def test_the_request_that_cancels_one_goal_has_its_id_and_no_time() -> None:
    assert cancel_of(ONE) == CDR + ONE + bytes(8)
    assert goal_of(cancel_of(ONE)) == ONE


@given(st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(raw: bytes) -> None:
    goals = Goals()
    for read in (
        lambda: goals.statuses(A, raw),
        lambda: goals.may_feed(A, raw),
        lambda: goals.ended(ONE, A, raw),
    ):
        with contextlib.suppress(RemoteError):
            read()
