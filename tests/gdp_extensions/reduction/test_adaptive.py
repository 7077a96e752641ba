"""Adaptive quality on a virtual link: the newest picture stays fresh while the rate of the path falls and rises."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from gdp_extensions.reduction.adaptive import AdaptBounds, AdaptiveQuality

MBIT = 1e6 / 8
FPS = 30
STEP_S = 0.001
PICTURE_BYTES = 45_000  # at quality 80


def picture_bytes(quality: int, chance: random.Random) -> int:
    """Return the size of a JPEG: another curve than the controller assumes."""
    return int(PICTURE_BYTES * (0.3 + 0.7 * (quality / 80) ** 2) * chance.uniform(0.9, 1.1))


@dataclass(slots=True)
class Sent:
    at_s: float
    left_bytes: float
    size: int
    seen_s: float | None = None  # when the sender sees that it has left


@dataclass(slots=True)
class Journey:
    """A camera of 30 Hz behind a FIFO of any depth, whose rate in bytes a second is a function of time."""

    rate: Callable[[float], float]
    is_known: bool
    bounds: AdaptBounds = field(default_factory=AdaptBounds)
    back_s: float = 0.0
    arrivals: list[tuple[float, float]] = field(default_factory=list)  # second of arrival, second of sending
    choices: list[tuple[float, int, float]] = field(default_factory=list)  # second, quality, rate
    carried_bytes: int = 0

    def run(self, duration_s: float) -> Journey:
        controller, chance = AdaptiveQuality(self.bounds), random.Random(1)
        waiting, on_way = deque[Sent](), deque[Sent]()
        looked_s, frame = float("-inf"), 0
        for tick in range(int(duration_s / STEP_S)):
            now_s = tick * STEP_S
            budget = self.rate(now_s) * STEP_S
            while waiting and budget > 0:
                taken = min(budget, waiting[0].left_bytes)
                waiting[0].left_bytes -= taken
                budget -= taken
                if waiting[0].left_bytes <= 0:
                    done = waiting.popleft()
                    done.seen_s = now_s + STEP_S + self.back_s
                    self.arrivals.append((now_s + STEP_S, done.at_s))
                    self.carried_bytes += done.size
            if now_s < frame / FPS:
                continue
            frame += 1
            while on_way and (seen_s := on_way[0].seen_s) is not None and seen_s <= now_s:
                controller.handle_left(max(looked_s - on_way.popleft().at_s, 0.0), now_s)
            looked_s = now_s
            if controller.may_send(now_s, self.rate(now_s) if self.is_known else None):
                size = picture_bytes(controller.quality, chance)
                sent = Sent(now_s, size, size)
                waiting.append(sent)
                on_way.append(sent)
                controller.handle_sent(size, now_s)
            self.choices.append((now_s, controller.quality, controller.rate_hz))
        return self

    def newest_age_s(self, since_s: float = 0.0) -> float:
        """Return the greatest age that the newest picture at the reader ever has."""
        return max(after - sent for (at_s, sent), (after, _) in pairwise(self.arrivals) if at_s >= since_s)

    def ages_s(self) -> list[float]:
        """Return the ages at arrival, rising."""
        return sorted(at_s - sent for at_s, sent in self.arrivals)

    def hz(self, begin_s: float, end_s: float) -> float:
        return sum(begin_s <= at_s < end_s for at_s, _ in self.arrivals) / (end_s - begin_s)


def falling(now_s: float) -> float:
    return (20 if now_s < 15 else 2) * MBIT


@pytest.mark.parametrize("is_known", [True, False])
def test_a_wide_path_carries_every_picture_at_the_best_quality(is_known: bool) -> None:
    journey = Journey(lambda _: 50 * MBIT, is_known).run(10)
    assert len(journey.arrivals) >= 299
    assert {quality for _, quality, _ in journey.choices} == {80}


@pytest.mark.parametrize("is_known", [True, False])
@pytest.mark.parametrize("mbit", [1, 3, 8])
def test_pictures_are_fresh_on_a_thin_path_and_use_most_of_it(mbit: float, is_known: bool) -> None:
    journey = Journey(lambda _: mbit * MBIT, is_known).run(40)
    own_s = PICTURE_BYTES / (mbit * MBIT)  # serialisation of the first ones
    ages_s = journey.ages_s()
    assert ages_s[int(0.95 * len(ages_s))] < 0.15 + own_s
    assert journey.newest_age_s(since_s=5) < 0.45 + own_s
    assert journey.carried_bytes > 0.6 * 40 * mbit * MBIT


def test_a_path_that_states_its_rate_is_used_without_backlog_when_it_falls() -> None:
    journey = Journey(falling, is_known=True).run(30)
    assert journey.newest_age_s() < 0.3
    assert journey.ages_s()[-1] < 0.2


@pytest.mark.parametrize("back_s", [0.0, 0.06])
def test_a_path_that_falls_without_a_word_is_stale_for_less_than_a_second(back_s: float) -> None:
    journey = Journey(falling, is_known=False, back_s=back_s).run(40)
    assert journey.newest_age_s() < 1.0
    assert journey.newest_age_s(since_s=18) < 0.45


def test_quality_falls_to_its_minimum_before_the_rate_falls() -> None:
    journey = Journey(lambda _: 8 * MBIT, is_known=True).run(10)
    assert all(rate_hz == float("inf") or quality == 30 for _, quality, rate_hz in journey.choices)
    assert {quality for at_s, quality, _ in journey.choices if at_s > 2} != {30}


def test_quality_recovers_slowly_and_wholly() -> None:
    journey = Journey(lambda now_s: (2 if now_s < 5 else 50) * MBIT, is_known=True).run(15)
    before = next(quality for at_s, quality, _ in journey.choices if at_s >= 4.9)
    after = next(quality for at_s, quality, _ in journey.choices if at_s >= 6)
    assert (before, journey.choices[-1][1]) == (30, 80)
    assert 35 <= after <= 45


@pytest.mark.parametrize("mbit", [3, 8])
def test_choices_do_not_swing_on_a_steady_path_that_states_its_rate(mbit: float) -> None:
    journey = Journey(lambda _: mbit * MBIT, is_known=True).run(40)
    steady = [choice for choice in journey.choices if choice[0] > 10]
    qualities = [quality for _, quality, _ in steady]
    assert max(qualities) - min(qualities) <= 8
    rates_hz = [rate_hz for _, _, rate_hz in steady if rate_hz != float("inf")]
    assert not rates_hz or max(rates_hz) < 1.3 * min(rates_hz)


def test_choices_swing_seldom_on_a_steady_path_that_states_nothing() -> None:
    journey = Journey(lambda _: 3 * MBIT, is_known=False).run(60)
    rates_hz = [rate_hz for at_s, _, rate_hz in journey.choices if at_s > 10]
    drops = sum(after < 0.9 * before for before, after in pairwise(rates_hz))
    assert drops <= 6


def test_a_wave_is_followed_and_pictures_stay_fresh() -> None:
    journey = Journey(lambda now_s: (5 + 4 * math.sin(now_s / 3)) * MBIT, is_known=True).run(40)
    assert journey.newest_age_s() < 0.6


def test_the_rate_never_falls_below_its_minimum_nor_rises_above_its_maximum() -> None:
    bounds = AdaptBounds(min_hz=2, max_hz=10)
    thin = Journey(lambda _: 0.05 * MBIT, is_known=True, bounds=bounds).run(10)
    assert min(rate_hz for _, _, rate_hz in thin.choices) == 2
    wide = Journey(lambda _: 50 * MBIT, is_known=True, bounds=bounds).run(10)
    assert 9.5 <= wide.hz(0, 10) <= 10.5


def test_messages_without_a_quality_adapt_by_their_rate_alone() -> None:
    bounds = AdaptBounds(has_quality=False)
    journey = Journey(lambda _: 5 * MBIT, is_known=True, bounds=bounds).run(20)
    assert {quality for _, quality, _ in journey.choices} == {80}
    assert 10 <= journey.hz(5, 20) <= 14


def test_dropped_and_refused_messages_lower_the_estimate_once_for_one_cause() -> None:
    controller = AdaptiveQuality(AdaptBounds())
    now_s = 0.0
    for number in range(60):
        now_s = number / FPS
        assert controller.may_send(now_s)
        controller.handle_sent(PICTURE_BYTES, now_s)
        controller.handle_left(0.0, now_s)
    controller.handle_sent(PICTURE_BYTES, now_s)
    controller.handle_sent(PICTURE_BYTES, now_s)
    controller.handle_dropped(1, now_s + 0.01)
    lowered = controller.estimate_bytes_s
    assert 0.6 * FPS * PICTURE_BYTES < lowered < 0.9 * FPS * PICTURE_BYTES
    controller.handle_dropped(1, now_s + 0.02)
    controller.handle_refused(now_s + 0.02)
    assert controller.estimate_bytes_s >= 0.9 * lowered
