"""Queries for names: repeated until answered, renewed while watched, bounded, and fair to each owner."""

from __future__ import annotations

from itertools import pairwise

from gdp.intervals import ADVERTISEMENT
from gdp.limits import PENDING_S
from gdp.names import Name
from gdp.switch.name_resolver import BATCH_MAX, QUERIES_MAX, RETRY_S, TRIES_MAX, WINDOW, NameResolver
from tests.gdp.switch.net import name
from tests.gdp.switch.test_name_cache import place

TOPIC, ME = name("topic"), name("me")


def polled(queries: NameResolver, now_s: float) -> list[tuple[Name, float]]:
    return [(query.name, query.watch_s) for query in queries.queries_to_send(now_s)]


def answer(queries: NameResolver, asked: Name, now_s: float) -> None:
    """Answer a query with what changes nothing else."""
    queries.receive_removal(asked, ME, now_s)


def test_a_query_is_sent_at_once_and_again_until_it_fails() -> None:
    queries, now_s, times = NameResolver(ME), 0.0, 0
    queries.request(TOPIC, now_s)
    while TOPIC in queries.requests:
        times += len(polled(queries, now_s))
        now_s += RETRY_S
    assert times == TRIES_MAX
    assert queries.next_query() is None


def test_two_requests_make_one_query() -> None:
    queries = NameResolver(ME)
    queries.request(TOPIC, 0.0)
    queries.request(TOPIC, 0.0)
    assert polled(queries, 0.0) == [(TOPIC, 0.0)]
    assert polled(queries, 0.0) == []


def test_an_answer_closes_a_query() -> None:
    queries = NameResolver(ME)
    queries.request(TOPIC, 0.0)
    answer(queries, TOPIC, 0.0)
    assert (TOPIC in queries.requests, queries.next_query()) == (False, None)


def test_a_watch_goes_on_after_its_answer() -> None:
    queries = NameResolver(ME)
    queries.watch(TOPIC, 0.0)
    answer(queries, TOPIC, 0.0)
    assert polled(queries, 1.0) == []
    assert polled(queries, ADVERTISEMENT.lease_s / 4) == [(TOPIC, ADVERTISEMENT.lease_s)]


def test_a_watch_is_sent_at_once_though_the_name_was_queried_before() -> None:
    queries = NameResolver(ME)
    queries.request(TOPIC, 0.0)
    assert polled(queries, 0.0) == [(TOPIC, 0.0)]
    queries.watch(TOPIC, 0.1)
    assert polled(queries, 0.1) == [(TOPIC, ADVERTISEMENT.lease_s)]


def test_a_request_repeats_a_query_that_was_answered() -> None:
    queries = NameResolver(ME)
    queries.watch(TOPIC, 0.0)
    answer(queries, TOPIC, 0.0)
    queries.request(TOPIC, 1.0)
    assert polled(queries, 1.0) == [(TOPIC, ADVERTISEMENT.lease_s)]


def test_requests_that_no_answer_satisfies_make_one_query_in_each_pause() -> None:
    queries, now_s, sent = NameResolver(ME), 0.0, 0
    queries.watch(TOPIC, now_s)
    while now_s < 40 * RETRY_S:
        sent += len(polled(queries, now_s))
        answer(queries, TOPIC, now_s)
        queries.request(TOPIC, now_s)
        now_s += RETRY_S / 100
    assert 38 <= sent <= 41


def test_a_used_name_is_watched_for_a_while_and_then_queried_no_more() -> None:
    queries, location = NameResolver(ME), place()
    queries.receive_location(location, 0.0)
    queries.resolve_any(TOPIC, 0.0)
    assert polled(queries, 0.0) == [(TOPIC, 2 * ADVERTISEMENT.lease_s)]
    answer(queries, TOPIC, 0.1)
    assert TOPIC in queries.requests
    assert polled(queries, 3 * ADVERTISEMENT.lease_s) == []
    assert TOPIC not in queries.requests


def test_a_new_rib_gets_every_query_at_once() -> None:
    queries = NameResolver(ME)
    queries.watch(TOPIC, 0.0)
    answer(queries, TOPIC, 0.0)
    queries.rib_changed(1.0, has_rib=True)
    assert polled(queries, 1.0) == [(TOPIC, ADVERTISEMENT.lease_s)]


def test_a_name_without_a_watch_is_not_queried_again() -> None:
    queries = NameResolver(ME)
    queries.watch(TOPIC, 0.0)
    queries.unwatch(TOPIC)
    assert (polled(queries, 1.0), queries.next_query()) == ([], None)


def test_open_queries_are_bounded_and_watches_are_not_counted() -> None:
    queries = NameResolver(ME)
    for number in range(QUERIES_MAX + 10):
        queries.request(name(str(number)), 0.0)
    queries.watch(TOPIC, 0.0)
    assert TOPIC in queries.requests
    assert name(str(QUERIES_MAX - 1)) in queries.requests
    assert name(str(QUERIES_MAX + 9)) not in queries.requests


def test_new_names_fill_a_window_and_each_answer_admits_another_name() -> None:
    queries = NameResolver(ME)
    for number in range(2 * WINDOW):
        queries.request(name(str(number)), 0.0)
    first = [each for _ in range(10) for each, _ in polled(queries, 0.0)]
    assert len(first) == WINDOW
    assert max(len(polled(queries, RETRY_S)), len(polled(queries, RETRY_S))) == BATCH_MAX  # the same ones again
    answer(queries, first[0], RETRY_S)
    assert [each for each, _ in polled(queries, RETRY_S)] == [name(str(WINDOW))]


def test_an_owner_of_many_queries_delays_no_other_owner() -> None:
    queries = NameResolver(ME)
    for number in range(2 * WINDOW):
        queries.request(name(str(number)), 0.0, owner=b"greedy")
    queries.request(TOPIC, 0.0, owner=b"modest")
    assert (TOPIC, 0.0) in polled(queries, 0.0)


def test_a_name_that_waits_too_long_for_the_window_fails_without_a_query() -> None:
    queries = NameResolver(ME)
    for number in range(WINDOW + 1):
        queries.request(name(str(number)), 0.0)
    first = [each for _ in range(10) for each, _ in polled(queries, 0.0)]
    late = name(str(WINDOW))
    assert late not in first
    answer(queries, first[0], PENDING_S)
    assert late not in [each for _ in range(10) for each, _ in polled(queries, PENDING_S)]
    assert late not in queries.requests


def test_a_watch_is_renewed_in_time_however_often_the_rib_sends_updates() -> None:
    queries = NameResolver(ME)
    queries.watch(TOPIC, 0.0)
    sent_s = []
    for now_s in range(60):
        sent_s += [now_s] if polled(queries, now_s) else []
        answer(queries, TOPIC, now_s)
    assert sent_s[0] == 0
    assert all(b - a <= ADVERTISEMENT.lease_s / 4 for a, b in pairwise(sent_s))
    assert len(sent_s) >= 60 / (ADVERTISEMENT.lease_s / 4)


def test_a_renewal_of_a_watch_is_repeated_until_a_response_comes() -> None:
    queries = NameResolver(ME)
    queries.watch(TOPIC, 0.0)
    polled(queries, 0.0)
    answer(queries, TOPIC, 0.0)
    renewed_s = ADVERTISEMENT.lease_s / 4
    due_s = renewed_s
    for pause_s in (RETRY_S, 2 * RETRY_S, 4 * RETRY_S, renewed_s, renewed_s):
        assert not polled(queries, due_s - 0.02)
        assert polled(queries, due_s) == [(TOPIC, ADVERTISEMENT.lease_s)]
        due_s += pause_s
    answer(queries, TOPIC, due_s)
    assert not polled(queries, due_s + renewed_s - 0.02)
    assert polled(queries, due_s + renewed_s) == [(TOPIC, ADVERTISEMENT.lease_s)]
