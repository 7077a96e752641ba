"""Requests to several servers: one callback for each call, with any events in any order."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.dispatch import GATHER_S, HEDGE_FIRST_S, Ask, Dispatch, Failure, Stop
from gdp.service.replication import ALL, Mode, Replication

A, B, C = (Name(bytes([number]) * 32) for number in (1, 2, 3))
SOME = Replication(Mode.SOME, copies=2)
HEDGED = Replication(Mode.HEDGED, budget=1.0)


@dataclass(slots=True)
class Bench:
    """Dispatch with servers, and the results of its calls."""

    replication: Replication = ALL
    servers: tuple[Name, ...] = (A, B, C)
    ends: dict[int, list[str]] = field(default_factory=dict)
    dispatch: Dispatch[str] = field(init=False)

    def __post_init__(self) -> None:
        self.dispatch = Dispatch(self.replication, start=0, calls_max=8, held_max_bytes=100)
        for server in self.servers:
            self.dispatch.replica_joined(server, 0.0)

    def begin(self, now_s: float = 0.0, timeout_s: float | None = 5.0, first: tuple[Name, ...] = ()) -> int:
        ends: list[str] = []
        number = self.dispatch.begin(
            now_s, lambda call: b"%d" % call, timeout_s, ends.append, lambda why, _: ends.append(why.value), first
        )
        self.ends[number] = ends
        return number

    def asked(self) -> list[tuple[Name, ...] | None]:
        return [each.servers for each in self.dispatch.poll_effects() if isinstance(each, Ask)]

    def stops(self, now_s: float) -> list[Stop]:
        self.dispatch.handle_timer(now_s)
        return [each for each in self.dispatch.poll_effects() if isinstance(each, Stop)]


def test_all_are_asked_by_the_tree_and_the_first_answer_wins() -> None:
    bench = Bench()
    call = bench.begin()
    assert bench.dispatch.poll_effects() == [Ask(call, b"0", None)]
    bench.dispatch.answered(call, B, "b", 0.1)
    bench.dispatch.answered(call, A, "a", 0.2)
    assert (bench.ends, bench.dispatch.late) == ({call: ["b"]}, 1)


def test_the_only_server_is_asked_by_its_own_stream_where_that_is_preferred() -> None:
    dispatch = Dispatch[str](ALL, start=0, unicasts=True)
    dispatch.replica_joined(A, 0.0)
    for servers in ((A,), None):  # the second call begins when there are two
        number = dispatch.begin(0.0, lambda _: b"?", None, lambda _: None, lambda *_: None)
        assert dispatch.poll_effects()[-1] == Ask(number, b"?", servers)
        dispatch.replica_joined(B, 0.0)
        dispatch.poll_effects()


def test_an_answer_of_one_that_was_not_asked_is_not_taken() -> None:
    bench = Bench(SOME)
    call = bench.begin()
    assert bench.asked() == [(A, B)]
    bench.dispatch.answered(call, C, "c", 0.1)
    bench.dispatch.answered(call, Name(bytes(32)), "forged", 0.1)
    assert (bench.ends[call], bench.dispatch.unexpected) == ([], 2)


def test_servers_that_owe_a_response_get_one_batched_message_a_little_later() -> None:
    bench = Bench()
    first, second, third = (bench.begin() for _ in range(3))
    for call in (first, second, third):
        bench.dispatch.answered(call, A, "a", 0.1)
    for server in (B, C):
        bench.dispatch.answered(third, server, "soon enough", 0.1 + GATHER_S / 2)
    bench.asked()
    assert bench.stops(0.1 + GATHER_S / 2) == []
    assert bench.dispatch.get_timer() == 0.1 + GATHER_S
    assert bench.stops(0.1 + GATHER_S) == [Stop((first, second), None)]
    assert bench.stops(9.0) == []


def test_with_some_each_gets_a_private_message_of_what_it_owes() -> None:
    bench = Bench(SOME)
    call = bench.begin()
    bench.dispatch.answered(call, A, "a", 0.1)
    assert bench.stops(0.2) == [Stop((call,), B)]


def test_some_are_those_that_answered_fastest_lately_and_untried_ones_get_tried() -> None:
    bench = Bench(SOME)
    call = bench.begin()
    assert bench.asked() == [(A, B)]
    bench.dispatch.answered(call, B, "b", 0.1)
    bench.dispatch.answered(call, A, "a", 0.3)
    call = bench.begin(1.0)
    assert bench.asked() == [(C, B)]
    bench.dispatch.answered(call, B, "b", 1.1)
    bench.dispatch.answered(call, C, "c", 3.0)
    bench.begin(4.0)
    assert bench.asked() == [(B, A)]
    bench.begin(60.0)
    assert bench.asked() == [(A, B)]  # long ago: any may be fast now


def test_one_that_answers_nothing_any_more_is_soon_asked_last() -> None:
    bench = Bench(Replication(Mode.SOME, copies=1), servers=(A, B))
    for server, took_s in ((A, 0.1), (B, 0.2)):
        bench.dispatch.answered(bench.begin(), server, "quick", took_s)
    bench.asked()
    for now_s in (1.0, 1.05, 1.3):
        bench.begin(now_s)
    assert bench.asked() == [(A,), (A,), (B,)]


def test_one_that_refuses_or_goes_is_replaced_at_once() -> None:
    bench = Bench(Replication(Mode.SOME, copies=1))
    call = bench.begin()
    bench.dispatch.refused(call, A, "busy", 0.1)
    bench.dispatch.replica_lost(B, 0.2, "gone")
    assert bench.asked() == [(A,), (B,), (C,)]
    bench.dispatch.answered(call, C, "c", 0.3)
    assert bench.ends[call] == ["c"]


@pytest.mark.parametrize("replication", [ALL, SOME, HEDGED])
def test_a_call_fails_when_all_refused_or_went(replication: Replication) -> None:
    bench = Bench(replication)
    refused, left = bench.begin(), bench.begin()
    for server in (A, B, C) * 3:  # responses of servers without a request are ignored
        bench.dispatch.refused(refused, server, "busy", 0.1)
    for server in (A, B, C):
        bench.dispatch.replica_lost(server, 0.2, "gone")
    assert bench.ends == {refused: ["refused by all"], left: ["no server"]}
    with pytest.raises(LocalError, match="no server"):
        bench.begin()


def test_a_negative_response_counts_if_no_server_sends_a_positive_one() -> None:
    bench = Bench(servers=(A, B))
    rejected, accepted, late = bench.begin(), bench.begin(), bench.begin()
    for call in (rejected, accepted, late):
        bench.dispatch.declined(call, A, "no", 0.1)
    bench.dispatch.declined(rejected, B, "no, too", 0.2)
    bench.dispatch.answered(accepted, B, "yes", 0.2)
    bench.dispatch.handle_timer(5.0)
    assert bench.ends == {rejected: ["no"], accepted: ["yes"], late: ["no"]}


def test_a_server_that_arrives_is_asked_what_is_under_way() -> None:
    bench = Bench(servers=(A,))
    call = bench.begin()
    bench.dispatch.replica_joined(B, 0.1)
    assert bench.asked() == [None, (B,)]
    bench.dispatch.replica_lost(A, 0.2, "gone")
    bench.dispatch.answered(call, B, "b", 0.3)
    assert bench.ends[call] == ["b"]


def test_a_server_that_leaves_is_asked_last_and_its_answer_is_good() -> None:
    bench = Bench(Replication(Mode.SOME, copies=1), servers=(A, B))
    first = bench.begin()
    bench.dispatch.replica_leaving(A)
    second = bench.begin(0.1)
    assert bench.asked() == [(A,), (B,)]
    bench.dispatch.answered(first, A, "a", 0.2)
    bench.dispatch.replica_lost(B, 0.3, "gone")
    assert (bench.ends[first], bench.asked()) == (["a"], [(A,)])
    bench.dispatch.answered(second, A, "still here", 0.4)
    assert bench.ends[second] == ["still here"]


def test_the_second_copy_goes_when_the_first_is_late() -> None:
    bench = Bench(HEDGED)
    call = bench.begin()
    assert bench.asked() == [(A,)]
    assert bench.dispatch.get_timer() == HEDGE_FIRST_S
    bench.dispatch.handle_timer(HEDGE_FIRST_S)
    assert bench.asked() == [(B,)]
    bench.dispatch.answered(call, B, "b", 0.1)
    assert bench.stops(0.2) == [Stop((call,), A)]


def test_a_first_copy_has_as_long_as_nearly_all_answers_took() -> None:
    bench = Bench(HEDGED)
    for number in range(100):
        bench.dispatch.answered(bench.begin(float(number)), *_one(bench), number + 0.002)
    bench.begin(200.0)
    assert bench.dispatch.get_timer() == pytest.approx(200.002)


def test_second_copies_stay_within_the_budget_but_replacements_are_free() -> None:
    bench = Bench(Replication(Mode.HEDGED, budget=0.02))
    hedged = 0
    for number in range(1_000):
        call = bench.begin(float(number))
        (chosen,) = (servers or () for servers in bench.asked())
        took_s = 0.6 if number % 33 == 32 else 0.01
        bench.dispatch.handle_timer(number + took_s - 0.001)
        bench.dispatch.answered(call, chosen[0], "an answer", number + took_s)
        bench.stops(number + 0.7)
        hedged = bench.dispatch.hedged
    assert 15 <= hedged <= 20
    call = bench.begin(2_000.0)
    for server in (A, B, C):
        bench.dispatch.refused(call, server, "busy", 2_000.1)
    assert bench.dispatch.hedged == hedged


def test_named_servers_are_asked_first_and_not_hedged() -> None:
    bench = Bench(HEDGED)
    call = bench.begin(first=(C,))
    assert (bench.asked(), bench.dispatch.get_timer()) == ([(C,)], 5.0)
    bench.dispatch.replica_lost(C, 0.1, "gone")
    assert bench.asked() == [(A,)]
    bench.dispatch.answered(call, A, "a", 0.2)


def test_what_is_held_is_bounded_in_number_and_in_bytes() -> None:
    bench = Bench()
    for _ in range(8):
        bench.begin()
    with pytest.raises(LocalError, match="8 calls"):
        bench.begin()
    bench.dispatch.fail_all("closed")
    bench.dispatch.begin(0.0, lambda _: bytes(101), 1.0, lambda _: None, lambda *_: None)
    with pytest.raises(LocalError, match="bytes are under way"):
        bench.begin()
    bench.dispatch.fail_all("closed")
    assert (len(bench.dispatch), bench.dispatch.held_bytes) == (0, 0)
    bench.begin()


def test_a_callback_may_begin_the_next_call() -> None:
    bench = Bench(servers=(A,))
    ends: list[str] = []

    def failed(why: Failure, reason: str) -> None:
        ends.append(why.value)
        bench.begin(1.0)

    bench.dispatch.begin(0.0, lambda _: b"", 1.0, ends.append, failed)
    bench.dispatch.handle_timer(1.0)
    assert (ends, len(bench.dispatch)) == (["timed out"], 1)


servers = st.sampled_from([A, B, C])
Step = st.one_of(
    st.tuples(st.just("begin"), st.sampled_from([0, 1, 3])),
    st.tuples(st.sampled_from(["answer", "refuse", "decline"]), st.tuples(st.integers(0, 9), servers)),
    st.tuples(st.sampled_from(["joined", "lost", "leaving"]), servers),
    st.tuples(st.just("wait"), st.sampled_from([0.001, 0.004, 0.05, 1.0])),
)


@given(st.sampled_from([ALL, SOME, HEDGED]), st.lists(Step, max_size=60))
def test_each_call_ends_exactly_once(replication: Replication, steps: list[tuple[str, object]]) -> None:
    bench, now_s = Bench(replication), 0.0
    dispatch, owed = bench.dispatch, dict[int, set[Name]]()
    live = {A, B, C}
    for step, value in steps:
        if step == "begin" and isinstance(value, int) and live and len(dispatch) < 8:
            bench.begin(now_s, value or None)
        elif isinstance(value, tuple):
            number, server = value
            before = len(bench.ends.get(number, ()))
            {"answer": dispatch.answered, "refuse": dispatch.refused, "decline": dispatch.declined}[step](
                number, server, step, now_s
            )
            if step == "answer" and not before and server in owed.get(number, ()):
                assert bench.ends[number] == ["answer"]
            if server not in owed.get(number, ()):
                assert len(bench.ends.get(number, ())) == before
            owed.get(number, set()).discard(server)
        elif isinstance(value, Name) and step == "joined":
            dispatch.replica_joined(value, now_s)
            live.add(value)
        elif isinstance(value, Name) and step == "lost":
            dispatch.replica_lost(value, now_s, "gone")
            live.discard(value)
            for whom in owed.values():
                whom.discard(value)
        elif isinstance(value, Name):
            dispatch.replica_leaving(value)
        elif isinstance(value, float):
            now_s += value
            dispatch.handle_timer(now_s)
            due_s = dispatch.get_timer()
            assert due_s is None or due_s > now_s
        for effect in dispatch.poll_effects():
            if isinstance(effect, Ask):
                whom = live if effect.servers is None else set(effect.servers)
                assert whom <= live
                assert not (whom & owed.setdefault(effect.call, set()))
                owed[effect.call] |= whom
        assert all(len(ends) <= 1 for ends in bench.ends.values())
        assert len(dispatch) == sum(not ends for ends in bench.ends.values())
        assert dispatch.held_bytes == sum(len(str(call)) for call, ends in bench.ends.items() if not ends)
        assert all(owed[call] & live for call, ends in bench.ends.items() if not ends)
    dispatch.fail_all("closed")
    assert all(len(ends) == 1 for ends in bench.ends.values())
    assert (len(dispatch), dispatch.held_bytes, dispatch.get_timer()) == (0, 0, None)


def _one(bench: Bench) -> tuple[Name, str]:
    """Return the servers of the last call, and a response."""
    whom = bench.asked()[-1]
    assert whom is not None
    return whom[0], "quick"
