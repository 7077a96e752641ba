"""Server or client that misbehaves within its rights: damage that it must not do to the others."""

from __future__ import annotations

import pytest

from gdp.errors import LocalError
from gdp.intervals import REFUSED_S
from gdp.names import Name
from gdp.service.dispatch import GATHER_S, HEDGE_FIRST_S, Ask, Dispatch, End
from gdp.service.replication import ALL, Mode, Replication
from gdp.service.replication_messages import LogId, ReplicaStatus, Snapshot, call_of
from gdp.service.sequencer import Sequencer
from gdp.service.serving import ENDED_MAX, Asked, Serving

FAST, SLOW, BAD = (Name(bytes([number]) * 32) for number in (1, 2, 3))
GREEDY, MODEST = (Name(bytes([number]) * 32) for number in (4, 5))
ONE = Replication(Mode.SOME, copies=1)
TWO = Replication(Mode.SOME, copies=2)
POOR = Replication(Mode.HEDGED, budget=0.0)


def dispatch_to(replication: Replication, *servers: Name) -> Dispatch[str]:
    dispatch = Dispatch[str](replication, start=0)
    for server in servers:
        dispatch.replica_joined(server, 0.0)
    return dispatch


def begin(dispatch: Dispatch[str], now_s: float, timeout_s: float | None = 5.0) -> int:
    return dispatch.begin(now_s, lambda _: b"request", timeout_s, lambda _: None, lambda *_: None)


def asked_first(dispatch: Dispatch[str]) -> tuple[Name, ...] | None:
    first, *_ = [each for each in dispatch.poll_effects() if isinstance(each, Ask)]
    return first.servers


def test_one_that_refuses_at_once_does_not_draw_the_requests() -> None:
    dispatch = dispatch_to(ONE, BAD, SLOW)
    call = begin(dispatch, 0.0)
    dispatch.refused(call, BAD, "no", 0.001)
    dispatch.answered(call, SLOW, "yes", 0.2)
    dispatch.poll_effects()
    begin(dispatch, 1.0)
    assert asked_first(dispatch) == (SLOW,)
    begin(dispatch, 1.0 + 2 * REFUSED_S)
    assert asked_first(dispatch) == (BAD,)  # it may work again by now


def test_one_that_rejects_goals_at_once_does_not_draw_them() -> None:
    dispatch = dispatch_to(ONE, BAD, SLOW)
    call = begin(dispatch, 0.0)
    dispatch.declined(call, BAD, "no", 0.001)
    dispatch.answered(call, SLOW, "yes", 0.2)
    dispatch.poll_effects()
    begin(dispatch, 1.0)
    assert asked_first(dispatch) == (SLOW,)


def test_one_that_says_nothing_does_not_take_the_second_copies_from_one_that_would_answer() -> None:
    dispatch, saved = dispatch_to(TWO, FAST, BAD, SLOW), 0
    for at_s in range(40):
        call = begin(dispatch, at_s)
        servers = asked_first(dispatch) or ()
        if at_s % 4 != 3:
            server, took_s = FAST, 0.01
        elif SLOW in servers:  # because the fast one is stuck
            server, took_s, saved = SLOW, 0.1, saved + 1
        else:
            server, took_s = FAST, 0.3
        dispatch.answered(call, server, "yes", at_s + took_s)
        dispatch.handle_timer(at_s + took_s + GATHER_S)
        dispatch.poll_effects()
    assert saved >= 8  # of ten


def test_late_calls_without_a_budget_cause_no_repeated_wakeups() -> None:
    dispatch = dispatch_to(POOR, FAST, SLOW)
    for _ in range(100):
        begin(dispatch, 0.0, None)
    dispatch.handle_timer(2 * HEDGE_FIRST_S)
    assert dispatch.get_timer() is None


def test_the_call_that_is_late_for_longest_gets_the_first_second_copy_that_requests_earn() -> None:
    dispatch = dispatch_to(Replication(Mode.HEDGED, budget=0.5), FAST, SLOW)
    oldest = begin(dispatch, 0.0)
    dispatch.handle_timer(2 * HEDGE_FIRST_S)
    asked_first(dispatch)
    newest = begin(dispatch, 1.0)
    copies = [each.call for each in dispatch.poll_effects() if isinstance(each, Ask)]
    assert copies == [newest, oldest]


def test_one_that_goes_and_comes_back_is_asked_each_call_once() -> None:
    dispatch = dispatch_to(ALL, FAST, BAD)
    call = begin(dispatch, 0.0)
    dispatch.poll_effects()
    for now_s in (1.0, 2.0):
        dispatch.replica_lost(BAD, now_s, "it describes itself again")
        dispatch.replica_joined(BAD, now_s)
    dispatch.replica_joined(SLOW, 3.0)
    assert dispatch.poll_effects() == [Ask(call, b"request", (SLOW,))]
    for server in (FAST, SLOW):
        dispatch.replica_lost(server, 4.0, "gone")
    assert dispatch.poll_effects() == [Ask(call, b"request", (BAD,))]  # when no other is left


def test_a_client_with_many_requests_waits_its_turn() -> None:
    serving: Serving[bytes] = Serving(0, at_once=1)
    numbers = [serving.begin(0.0, None, Asked(GREEDY, 0, call), b"") for call in range(100)]
    serving.begin(0.0, None, Asked(MODEST, 0, 0), b"")
    assert [turn.asked.client for turn in serving.poll_turns(0.0)] == [GREEDY]
    serving.end(numbers[0])
    clients = []
    for _ in range(2):
        (turn,) = serving.poll_turns(0.0)
        clients.append(turn.asked.client)
        serving.end(turn.number)
    assert set(clients) == {GREEDY, MODEST}


def test_a_client_leaves_capacity_for_the_next_in_number_and_in_bytes() -> None:
    for serving in (Serving[bytes](0, 1, limit=8), Serving[bytes](0, 1, waiting_max_bytes=80)):
        for call in range(4):
            serving.begin(0.0, None, Asked(GREEDY, 0, call), bytes(10))
        with pytest.raises(LocalError):
            serving.begin(0.0, None, Asked(GREEDY, 0, 4), bytes(10))
        serving.begin(0.0, None, Asked(MODEST, 0, 0), bytes(10))


def test_capacity_is_free_again_after_any_kind_of_end() -> None:
    serving: Serving[bytes] = Serving(0, 1, limit=8)
    for at_s in range(50):
        for call in range(4):
            after = Asked(GREEDY, 0, 4 * at_s) if call == 3 else None
            serving.begin(at_s, 0.5, Asked(GREEDY, 0, 4 * at_s + call), bytes(10), after)
        (turn,) = serving.poll_turns(0.0)
        serving.stop(Asked(GREEDY, 0, 4 * at_s + 1))
        serving.end(turn.number)
        serving.expired(at_s + 0.5)
        assert len(serving) == 0


def test_words_of_one_client_do_not_push_out_what_another_was_answered() -> None:
    serving: Serving[bytes] = Serving(0)
    serving.remember(Asked(MODEST, 0, 0), b"answer")
    for call in range(2 * ENDED_MAX):
        serving.stop(Asked(GREEDY, 0, call))
    assert serving.answer_of(Asked(MODEST, 0, 0)) == b"answer"
    assert serving.answer_of(Asked(GREEDY, 0, 0)) is None


def test_a_replica_that_reports_more_than_the_log_has_does_not_break_it() -> None:
    sequencer = Sequencer[str](incarnation_id=lambda: 7)
    sequencer.replica_joined(BAD, 0.0)
    sequencer.positioned(BAD, ReplicaStatus(tells=True), 0.1)
    sequencer.handle_timer(2.0)
    sequencer.positioned(BAD, ReplicaStatus(sequencer.log, 0, 0, tells=True), 2.1)
    ends: list[str] = []
    call = sequencer.begin(2.2, lambda _: b"request", 5.0, ends.append, lambda why, _: ends.append(why.value))
    sequencer.answered(call_of(sequencer.log, 1_000), BAD, "far ahead", 2.3)
    sequencer.positioned(BAD, Snapshot(sequencer.log, 1_000, b"state"), 2.4)
    sequencer.positioned(BAD, ReplicaStatus(sequencer.log, 1_000, 1_000, tells=True), 2.5)
    assert (sequencer.unexpected, ends) == (1, [])
    sequencer.positioned(BAD, ReplicaStatus(sequencer.log, 0, 0, tells=True), 2.6)
    sequencer.answered(call, BAD, "the answer", 2.7)
    assert ends == ["the answer"]


def test_a_request_whose_call_has_ended_is_not_sent() -> None:
    dispatch = dispatch_to(ONE, FAST, SLOW)
    call = begin(dispatch, 0.0)
    dispatch.poll_effects()
    for server in (FAST, SLOW):
        dispatch.replica_lost(server, 0.1, "both in one moment")
    assert dispatch.poll_effects() == [End(call)]


def test_a_request_beyond_the_capacity_is_not_even_written() -> None:
    written: list[int] = []

    def write(call: int) -> bytes:
        written.append(call)
        return b""

    dispatch = Dispatch[str](start=0, calls_max=1)
    dispatch.replica_joined(FAST, 0.0)
    begin(dispatch, 0.0)
    full = Dispatch[str](start=0, held_max_bytes=len(b"request"))
    full.replica_joined(FAST, 0.0)
    begin(full, 0.0)
    for each in (dispatch, full):
        with pytest.raises(LocalError):
            each.begin(0.0, write, 5.0, lambda _: None, lambda *_: None)
    assert written == []


def test_a_replica_cannot_report_a_log_after_which_there_is_none() -> None:
    sequencer = Sequencer[str](incarnation_id=lambda: 7)
    sequencer.replica_joined(BAD, 0.0)
    sequencer.positioned(BAD, ReplicaStatus(LogId((1 << 64) - 1, 5), 3, 3), 0.1)
    sequencer.handle_timer(2.0)
    assert (sequencer.unexpected, sequencer.log.generation) == (1, 0)
