"""Which RIB of the tiers above is used, and when it counts as silent."""

from __future__ import annotations

from gdp.intervals import RETRY_S
from gdp.rib.upstream_advertisements import PROBE_S, SILENT_MIN_S, UpstreamAdvertisements
from tests.gdp.switch.net import name

FIRST, SECOND = name("first"), name("second")


def silent_first() -> UpstreamAdvertisements:
    """Return a tier above whose first RIB left a probe at 1 s unanswered, so that the second one is used."""
    upstream = UpstreamAdvertisements((FIRST, SECOND))
    assert upstream.probe(PROBE_S, PROBE_S)
    assert not upstream.turn_over(PROBE_S)
    assert upstream.turn_over(PROBE_S + SILENT_MIN_S)
    assert upstream.rib == SECOND
    return upstream


def test_a_preferred_rib_is_used_again_once_it_answers_a_probe() -> None:
    upstream = silent_first()
    left_s = PROBE_S + SILENT_MIN_S
    assert upstream.preferred(left_s + RETRY_S - 0.01) == ()
    assert upstream.preferred(left_s + RETRY_S) == (FIRST,)
    assert upstream.preferred(left_s + RETRY_S + 0.01) == ()
    assert upstream.preferred(left_s + 2 * RETRY_S) == (FIRST,)
    assert upstream.record_alive(FIRST, left_s + 2 * RETRY_S + 0.1)
    assert upstream.rib == FIRST
    assert upstream.preferred(left_s + 9 * RETRY_S) == ()


def test_a_late_answer_of_a_slow_rib_does_not_bring_it_back() -> None:
    upstream = silent_first()
    assert not upstream.record_alive(FIRST, PROBE_S + SILENT_MIN_S + 0.01)
    assert upstream.rib == SECOND


def test_a_tier_that_owes_an_answer_is_silent_until_any_of_its_ribs_is_heard() -> None:
    upstream = UpstreamAdvertisements((FIRST, SECOND))
    assert not upstream.is_silent(1_000.0)
    upstream.record_asked(1.0)
    upstream.record_asked(1.0 + 2 * PROBE_S / 2)
    assert not upstream.is_silent(1.0 + 2 * PROBE_S - 0.01)
    assert upstream.is_silent(1.0 + 2 * PROBE_S)
    assert upstream.record_alive(SECOND, 1.0 + 2 * PROBE_S), "all queries are due: it is back"
    assert not upstream.is_silent(1.0 + 2 * PROBE_S)
    assert not upstream.record_alive(SECOND, 2.0 + 2 * PROBE_S)
