"""Queries to the tier above: when those of watched names are sent again."""

from __future__ import annotations

import pytest

from gdp.intervals import ADVERTISEMENT
from gdp.rib.upstream_queries import RETRY_S, WATCH, UpstreamQueries
from gdp.rib.watches import Asker
from tests.gdp.switch.net import name

TOPIC = name("topic")
ASKER = Asker(name("switch"), name("domain"), is_rib=False)


def watched(lease_s: float = ADVERTISEMENT.lease_s) -> UpstreamQueries:
    """Return the queries of a RIB that got a response for a watched name at 0 s, with this lease."""
    queries = UpstreamQueries(is_top=False)
    assert queries.request(TOPIC, ASKER, 1_000.0, 0.0, is_known=False)
    assert queries.answered(TOPIC, 0.0, lease_s) == [ASKER]
    return queries


def asks(queries: UpstreamQueries, now_s: float) -> bool:
    return bool(queries.due(now_s)[0])


@pytest.mark.parametrize(
    ("lease_s", "again_s"),
    [(ADVERTISEMENT.lease_s, WATCH.refresh_s), (2.4, 0.8), (0.0, RETRY_S), (1e9, WATCH.refresh_s)],
)
def test_a_watch_is_renewed_while_the_lease_of_the_response_lasts(lease_s: float, again_s: float) -> None:
    queries = watched(lease_s)
    assert queries.next_due() <= again_s  # type: ignore[operator]
    assert not asks(queries, again_s - 0.01)
    assert asks(queries, again_s)


def test_an_update_with_a_short_lease_is_renewed_in_time_and_one_with_a_long_lease_postpones_nothing() -> None:
    queries = watched(1e9)
    queries.answered(TOPIC, 1.0, 2.4)
    assert asks(queries, 1.8)
    queries = watched(2.4)
    queries.answered(TOPIC, 0.5, 1e9)
    assert asks(queries, 0.8)


def test_a_renewal_is_repeated_until_a_response_comes() -> None:
    queries = watched()
    due_s = WATCH.refresh_s
    for doubled in range(5):
        assert not asks(queries, due_s - 0.01)
        assert asks(queries, due_s)
        due_s += WATCH.refresh_s if doubled == 4 else RETRY_S * 2**doubled
    assert asks(queries, due_s)
    assert queries.answered(TOPIC, due_s) == []
    assert not asks(queries, due_s + WATCH.refresh_s - 0.01)
    assert asks(queries, due_s + WATCH.refresh_s)


def test_an_update_without_a_query_renews_no_watch() -> None:
    queries = watched()
    queries.answered(TOPIC, WATCH.refresh_s - 0.5)
    assert asks(queries, WATCH.refresh_s)


def test_a_silent_tier_gets_one_query_for_each_renewal() -> None:
    queries = watched()
    assert queries.due(WATCH.refresh_s, is_silent=True)[0]
    assert not queries.due(2 * WATCH.refresh_s - 0.01, is_silent=True)[0]
    (query,) = queries.due(2 * WATCH.refresh_s, is_silent=True)[0]
    assert query.is_unanswered
    assert query.again_s == 3 * WATCH.refresh_s
