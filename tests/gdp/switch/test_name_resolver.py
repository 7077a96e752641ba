"""Name resolution at a switch: one miss from the query to the frame, and every event that can end it."""

from __future__ import annotations

from dataclasses import replace

from gdp.errors import DropReason
from gdp.intervals import ADVERTISEMENT, NEGATIVE_LEASE_S
from gdp.limits import PENDING_S, QUESTIONS_RATE
from gdp.names import Name
from gdp.switch.name_cache import Location
from gdp.switch.name_resolver import QUERIES_MAX, RETRY_S, TRIES_MAX, NameResolver
from gdp.trust.right import Right
from tests.gdp.switch.net import HOME, name

ME, FAR, SERVER, TOPIC, RIB = name("me"), name("far"), name("server"), name("topic"), name("rib")
NEIGHBOUR = b"n" + name("neighbour")


def location(of: Name = SERVER, right: Right = Right.ATTACH, switch: Name = FAR, expires_s: float = 30.0) -> Location:
    return Location(
        name=of,
        advertiser=name("robot"),
        right=right,
        switch=switch,
        domain=HOME,
        transit=frozenset(),
        advertisement=b"claim",
        expires_s=expires_s,
    )


def due(resolver: NameResolver, now_s: float) -> list[tuple[Name, float]]:
    """Return the queries to send, each with the seconds for which its name is to be watched."""
    return [(query.name, query.watch_s) for query in resolver.queries_to_send(now_s)]


def missed() -> NameResolver:
    """Return a resolver with one frame that waits for ``SERVER``, whose query was sent."""
    resolver = NameResolver(ME)
    assert resolver.resolve(SERVER, 0.0, NEIGHBOUR) is None
    resolver.buffer_frame(SERVER, b"frame", 0.0, NEIGHBOUR)
    assert due(resolver, 0.0) == [(SERVER, 0.0)]
    return resolver


def test_a_location_answers_the_query_and_releases_the_frame() -> None:
    resolver = missed()
    resolver.receive_location(location(), 0.1)
    assert resolver.resolve(SERVER, 0.1, NEIGHBOUR) == [location()]
    assert resolver.pending.release(SERVER) == [(b"frame", PENDING_S, NEIGHBOUR)]
    assert (len(resolver.pending), resolver.pending.drops.total()) == (0, 0)


def test_a_negative_answer_drops_the_frame_and_stands_for_a_moment() -> None:
    resolver = missed()
    resolver.receive_negative(SERVER, 0.1)
    assert resolver.pending.drops == {DropReason.NO_ROUTE: 1}
    assert resolver.resolve(SERVER, 0.2) is DropReason.NO_ROUTE
    assert resolver.resolve(SERVER, 0.1 + NEGATIVE_LEASE_S) is None


def test_a_rib_that_has_just_started_does_not_remove_known_locations() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(location(), 0.0)
    resolver.receive_negative(SERVER, 0.1, keep=True)
    assert resolver.resolve(SERVER, 0.1) == [location()]


def test_a_location_that_a_rib_does_not_know_gets_another_lease_up_to_the_end_of_its_proofs() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(replace(location(), stale_until_s=70.0), 0.0)
    for now_s in range(20, 200, 20):
        resolver.receive_unknown(SERVER, RIB, float(now_s), {RIB})
        resolver.expire(float(now_s))
        assert bool(resolver.cache.of(SERVER, float(now_s))) == (now_s < 70)


def test_a_name_that_one_rib_does_not_know_is_queried_at_each_other_one_once_and_then_later() -> None:
    resolver = NameResolver(ME)
    resolver.watch(SERVER, 0.0)
    others = {name(f"rib{number}") for number in range(3)}
    asked: list[Name] = []
    for rib in sorted(others):
        (query,) = resolver.queries_to_send(0.1 * len(asked))
        assert (query.name, query.passed_over) == (SERVER, set(asked))
        resolver.receive_unknown(SERVER, rib, 0.1 * len(asked), others)
        asked.append(rib)
    assert resolver.queries_to_send(1.0) == []
    (query,) = resolver.queries_to_send(ADVERTISEMENT.lease_s / 4 + 0.3)
    assert query.passed_over == set()


def test_a_frame_waits_while_ribs_do_not_know_its_name_and_then_is_dropped() -> None:
    resolver = missed()
    resolver.receive_unknown(SERVER, RIB, 0.1, {RIB})
    assert len(resolver.pending) == 1
    resolver.expire(PENDING_S)
    assert resolver.pending.drops == {DropReason.PENDING_EXPIRED: 1}


def test_a_rib_that_has_just_started_may_deny_an_unknown_name() -> None:
    resolver = missed()
    resolver.receive_negative(SERVER, 0.1, keep=True)
    assert resolver.pending.drops == {DropReason.NO_ROUTE: 1}


def test_a_query_without_an_answer_drops_the_frame_when_it_fails() -> None:
    resolver = missed()
    for tries in range(1, TRIES_MAX + 4):
        resolver.queries_to_send(tries * RETRY_S)
    assert (len(resolver.requests), len(resolver.pending)) == (0, 0)
    assert resolver.pending.drops == {DropReason.NO_ROUTE: 1}


def test_a_frame_expires_while_its_query_is_open() -> None:
    resolver = missed()
    assert resolver.next_expiry() == PENDING_S
    resolver.expire(PENDING_S)
    assert resolver.pending.drops == {DropReason.PENDING_EXPIRED: 1}
    assert len(resolver.requests) == 1


def test_a_frame_that_has_no_query_is_counted() -> None:
    resolver = NameResolver(ME)
    for number in range(QUERIES_MAX):
        resolver.resolve(name(str(number)), 0.0)
    resolver.resolve(SERVER, 0.0)
    resolver.buffer_frame(SERVER, b"frame", 0.0, NEIGHBOUR)
    assert (len(resolver.pending), resolver.pending.drops) == (0, {DropReason.PENDING_FULL: 1})


def test_a_neighbour_above_its_rate_opens_no_query() -> None:
    resolver = NameResolver(ME)
    for number in range(int(QUESTIONS_RATE.burst) + 10):
        resolver.resolve(name(str(number)), 0.0, NEIGHBOUR)
    assert len(resolver.requests) == QUESTIONS_RATE.burst
    resolver.resolve(SERVER, 0.0, b"n" + name("other"))
    assert len(resolver.requests) == QUESTIONS_RATE.burst + 1


def test_a_name_that_only_publishes_has_no_reader() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(location(TOPIC, Right.PUBLISH), 0.0)
    assert resolver.resolve(TOPIC, 0.0) is DropReason.NO_READER


def test_a_node_is_found_by_any_name_that_it_advertises() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(location(TOPIC, Right.PUBLISH), 0.0)
    assert resolver.resolve(name("robot"), 0.0) == [location(TOPIC, Right.PUBLISH)]


def test_a_node_that_has_left_this_switch_is_queried_again() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(location(switch=ME), 0.0, is_ours=True, has_left=True)
    assert resolver.resolve(SERVER, 0.0) is None
    assert due(resolver, 0.0) == [(SERVER, 0.0)]


def test_where_clients_of_a_server_that_has_left_are_does_not_end_the_query_for_it() -> None:
    resolver = missed()
    for at_s in (0.1, 0.2):
        resolver.receive_location(location(right=Right.SERVE, switch=ME), at_s, is_ours=True, has_left=True)
        resolver.receive_location(replace(location(right=Right.CALL), advertiser=name("client")), at_s)
        assert resolver.resolve(SERVER, at_s, NEIGHBOUR) is None
        assert due(resolver, at_s) == []
    assert due(resolver, RETRY_S) == [(SERVER, 0.0)]
    resolver.receive_location(replace(location(right=Right.SERVE), advertiser=name("other")), RETRY_S)
    assert due(resolver, 10 * RETRY_S) == []


def test_a_source_is_located_whatever_its_right() -> None:
    resolver = NameResolver(ME)
    assert resolver.resolve_any(TOPIC, 0.0) is None
    resolver.receive_location(location(TOPIC, Right.PUBLISH), 0.0)
    assert resolver.resolve_any(TOPIC, 0.0) == [location(TOPIC, Right.PUBLISH)]


def test_a_location_that_is_used_is_watched() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(location(), 0.0)
    resolver.resolve(SERVER, 0.0)
    assert due(resolver, 0.0) == [(SERVER, 2 * ADVERTISEMENT.lease_s)]


def test_a_location_outlives_its_lease_only_while_no_rib_answers() -> None:
    resolver = NameResolver(ME)
    resolver.receive_location(replace(location(expires_s=1.0), stale_until_s=9.0), 0.0)
    resolver.cache.serve_stale(True, 0.5)
    assert resolver.expire(2.0) == []
    resolver.receive_removal(SERVER, name("robot"), 2.0)
    assert resolver.resolve(SERVER, 2.0) is None


def test_a_new_rib_gets_every_watch_at_once() -> None:
    resolver = NameResolver(ME)
    resolver.watch(TOPIC, 0.0)
    assert due(resolver, 0.0) == [(TOPIC, ADVERTISEMENT.lease_s)]
    resolver.receive_location(location(TOPIC, Right.PUBLISH), 0.0)
    assert due(resolver, 1.0) == []
    resolver.rib_changed(1.0, has_rib=True)
    assert due(resolver, 1.0) == [(TOPIC, ADVERTISEMENT.lease_s)]


def test_the_echo_of_a_relayed_advertisement_answers_no_query_until_it_is_repeated() -> None:
    resolver = NameResolver(ME)
    watch = [(TOPIC, ADVERTISEMENT.lease_s)]
    resolver.watch(TOPIC, 0.0)
    assert due(resolver, 0.0) == watch
    resolver.receive_location(location(TOPIC), 0.01, is_ours=True)
    assert due(resolver, RETRY_S) == watch
    resolver.receive_location(location(TOPIC), RETRY_S + 0.01, is_ours=True)
    assert due(resolver, 2 * RETRY_S + 0.1) == []
    assert due(resolver, ADVERTISEMENT.lease_s / 4 + 1) == watch


def test_a_watch_is_renewed_well_before_the_lease_of_any_location_of_its_answer_ends() -> None:
    resolver = NameResolver(ME)
    resolver.watch(TOPIC, 0.0)
    watch = due(resolver, 0.0)
    short = replace(location(TOPIC, Right.PUBLISH, expires_s=2.0), advertiser=name("short"))
    for each in (location(TOPIC, Right.PUBLISH), short, location(TOPIC, Right.PUBLISH)):
        resolver.receive_location(each, 0.0)
    assert due(resolver, 0.9) == []
    assert due(resolver, 1.0) == watch


def test_a_location_whose_lease_is_about_to_end_is_queried_no_sooner_than_after_a_retry() -> None:
    resolver = NameResolver(ME)
    resolver.watch(TOPIC, 0.0)
    watch = due(resolver, 0.0)
    resolver.receive_location(location(TOPIC, Right.PUBLISH, expires_s=0.01), 0.0)
    assert due(resolver, 0.9 * RETRY_S) == []
    assert due(resolver, RETRY_S) == watch
