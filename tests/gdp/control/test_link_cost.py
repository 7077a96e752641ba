"""Cost of a link: its formula, its damping under noise, and what a lasting change does."""

from __future__ import annotations

import random
from bisect import bisect_left
from collections.abc import Callable
from itertools import pairwise, product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.control.link_cost import (
    BETTER_S,
    COST_MAX,
    COST_UNMEASURED,
    INTERVAL_S,
    WORSE_S,
    DampedCost,
    link_cost,
)
from gdp.control.link_quality import LOSS_WINDOW, LinkQuality, LossWindow, RttEstimator

EVERY_S = 0.07
FOLLOWED = 1.3  # the band, and a little noise
SEEDS = st.integers(0, 2**32 - 1)

Series = Callable[[float], float]  # seconds to the round-trip time


def changes(rtt_at: Series, duration_s: float) -> list[tuple[float, int]]:
    """Return when the advertised cost changed, and to what, for round-trip times by second."""
    rtt, cost, found = RttEstimator(), DampedCost(), []
    for step in range(int(duration_s / EVERY_S)):
        now_s = step * EVERY_S
        if rtt.add(rtt_at(now_s), now_s) and cost.update(link_cost(rtt.srtt_s or 0.0, 0.0, 0.0), now_s):
            found.append((now_s, cost.advertised))
    return found


def noisy(base_s: float, seed: int) -> Series:
    """Return round-trip times with noise of half their size; every tenth one is ten times as long."""
    chance = random.Random(seed)
    return lambda _: base_s * (1 + chance.random() / 2) * (10 if chance.random() < 0.1 else 1)


@pytest.mark.parametrize(
    ("rtt_s", "loss", "least", "most"),
    [(0.0, 0.0, 10, 10), (0.001, 0.0, 10, 12), (0.02, 0.0, 30, 30), (0.0, 0.3, 80, 90), (0.02, 0.1, 50, 60)],
)
def test_a_slow_or_lossy_link_costs_clearly_more_than_a_local_cable(
    rtt_s: float, loss: float, least: int, most: int
) -> None:
    assert least <= link_cost(rtt_s, loss, loss) <= most


@given(st.floats(0, 1e4), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1e4), st.floats(0, 1), st.floats(0, 1))
def test_the_cost_is_bounded_and_rises_with_time_and_loss(
    rtt_s: float, loss_in: float, loss_out: float, more_s: float, more_in: float, more_out: float
) -> None:
    here = link_cost(rtt_s, loss_in, loss_out)
    worse = link_cost(rtt_s + more_s, min(loss_in + more_in, 1.0), min(loss_out + more_out, 1.0))
    assert 1 <= here <= worse <= COST_MAX


@given(SEEDS, st.sampled_from([0.0005, 0.005, 0.02, 0.2]))
def test_a_noisy_link_changes_its_measured_cost_at_most_once_in_a_minute(seed: int, base_s: float) -> None:
    assert len(changes(noisy(base_s, seed), 60.0)) <= 2  # the first measurement may be an extreme one


@given(st.lists(st.sampled_from([0.001, 0.01, 0.02, 0.05, 0.1, 0.5]), min_size=1, max_size=30), st.integers(1, 10))
def test_no_series_changes_the_cost_more_often_than_the_interval_allows(levels: list[float], hold_s: int) -> None:
    at_s = [when for when, _ in changes(lambda now_s: levels[int(now_s / hold_s) % len(levels)], 120.0)]
    assert all(later - earlier >= INTERVAL_S for earlier, later in pairwise(at_s))


@given(SEEDS, st.integers(2, 40))
def test_a_link_that_alternates_changes_at_most_eight_times_in_any_minute(seed: int, half_period_s: int) -> None:
    slow, fast = noisy(0.1, seed), noisy(0.01, seed)
    at_s = [when for when, _ in changes(lambda now_s: (slow, fast)[int(now_s / half_period_s) % 2](now_s), 180.0)]
    assert max((bisect_left(at_s, when + 60.0) - place for place, when in enumerate(at_s)), default=0) <= 8


@given(SEEDS)
def test_a_link_that_stays_three_times_slower_is_followed_within_fifteen_seconds(seed: int) -> None:
    before, after = noisy(0.02, seed), noisy(0.06, seed)
    found = changes(lambda now_s: (before if now_s < 30.0 else after)(now_s), 60.0)
    (_, first), *_ = found
    last = [cost for when, cost in found if when < 45.0][-1]
    assert first < 40
    assert last > 70 / FOLLOWED


@given(SEEDS)
def test_a_link_that_stays_three_times_faster_is_followed_within_twenty_five_seconds(seed: int) -> None:
    before, after = noisy(0.06, seed), noisy(0.02, seed)
    found = changes(lambda now_s: (before if now_s < 30.0 else after)(now_s), 60.0)
    last = [cost for when, cost in found if when < 55.0][-1]
    assert last < 30 * FOLLOWED


def test_a_short_dip_or_rise_changes_nothing() -> None:
    cost = DampedCost()
    assert cost.update(40, 0.0)
    assert not any(cost.update(80, 10.0 + step / 2) for step in range(int(2 * WORSE_S)))
    assert not cost.update(41, 13.0)
    assert not any(cost.update(20, 20.0 + step / 2) for step in range(int(2 * BETTER_S)))
    assert cost.advertised == 40


def test_an_unmeasured_link_is_dear_and_the_first_measurement_counts_at_once() -> None:
    cost = DampedCost()
    assert cost.advertised == COST_UNMEASURED
    assert cost.update(10, 0.0)
    assert cost.advertised == 10


def test_the_round_trip_time_is_smoothed_as_rfc_6298_says() -> None:
    rtt = RttEstimator()
    for now_s in (0.0, 0.5):
        rtt.add(0.1, now_s)
    assert (rtt.srtt_s, rtt.rttvar_s) == (0.1, 0.05)
    for now_s in (1.0, 1.5):
        rtt.add(0.18, now_s)
    assert (rtt.srtt_s, rtt.rttvar_s) == pytest.approx((0.11, 0.0575))


def test_one_frame_in_half_a_second_that_was_not_delayed_suffices() -> None:
    rtt = RttEstimator()
    for now_s, sample_s in enumerate((0.4, 0.01, 0.9)):
        rtt.add(sample_s, now_s / 4)
    assert rtt.srtt_s == 0.01


@pytest.mark.parametrize(("every", "share"), [(1, 0.0), (2, 0.5), (4, 0.75)])
def test_loss_is_the_share_of_counts_that_did_not_come(every: int, share: float) -> None:
    window = LossWindow()
    for sent in range(1, 4 * LOSS_WINDOW, every):
        window.record(sent)
    assert window.loss == pytest.approx(share, abs=0.01)


def test_loss_is_forgotten_after_its_window() -> None:
    window = LossWindow()
    window.record(1)
    window.record(100)
    assert window.loss > 0.9
    for sent in range(101, 101 + LOSS_WINDOW):
        window.record(sent)
    assert window.loss == 0


@given(st.lists(st.integers(0, 2**64 - 1), max_size=50))
def test_any_counts_give_a_share_below_one(counts: list[int]) -> None:
    window = LossWindow()
    for sent in counts:
        window.record(sent)
    assert 0 <= window.loss < 1


def test_a_neighbour_that_counts_from_the_beginning_again_has_lost_nothing() -> None:
    window = LossWindow()
    for first, is_new in product((1, 5_000, 1), (True, False)):
        if is_new:
            window.begin_session()
        for sent in range(first, first + 10):
            window.record(sent)
    assert window.loss == 0


def test_the_time_for_which_the_neighbour_held_the_echo_does_not_count() -> None:
    here, there = LinkQuality(), LinkQuality()
    for step in range(20):
        now_s = step * 0.1
        there.receive(here.report_to_send(now_s), now_s + 0.01)
        here.receive(there.report_to_send(now_s + 0.06), now_s + 0.07)
    assert here.rtt.srtt_s == pytest.approx(0.02, abs=1e-5)


def test_an_impossible_echo_is_ignored() -> None:
    here = LinkQuality()
    here.report_to_send(0.0)
    ours = LinkQuality().report_to_send(0.0)
    for echo, held_us in ((2, 0), (2**64 - 1, 0), (1, 2**32 - 1), (0, 0)):
        for now_s in (0.1, 1.0):
            here.receive(ours._replace(echo=echo, held_us=held_us), now_s)
    assert here.rtt.srtt_s is None
