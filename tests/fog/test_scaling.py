"""Scaling policy: the number of machines by load, by schedule and within a budget."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timezone

import pytest

from fog.cluster import CloudNode, ClusterPlan
from fog.scaling import Autoscaler, CallCounts, policy_from_keys
from gdp.errors import LocalError
from tests.fog.supervisor.machines import SPOT

MONDAY_S = datetime(2024, 1, 1, tzinfo=timezone.utc).timestamp()


def at(day: int, hour: float) -> float:
    """Return a time of a week; Monday is day 0."""
    return MONDAY_S + 86_400 * day + 3_600 * hour


def loaded(keys: Mapping[str, object], calls_per_s: float, ms: float = 10.0, seconds: float = 30.0) -> Autoscaler:
    """Return a scaler that has seen a steady load."""
    scaler = Autoscaler(policy_from_keys(keys))
    for step in range(int(seconds / 2) + 1):
        calls = int(2 * step * calls_per_s)
        scaler.observe(CallCounts(calls, calls * ms), at(0, 12) + 2 * step)
    return scaler


def decided(scaler: Autoscaler, machines: int, usd: float | None = None, after_s: float = 30.0) -> int:
    return scaler.decide(machines, usd, at(0, 12) + after_s)


@pytest.mark.parametrize(("rate", "machines"), [(1.0, 1), (25.0, 3), (200.0, 5)])
def test_machines_follow_calls_a_second_between_the_bounds(rate: float, machines: int) -> None:
    assert decided(loaded({"max": 5, "target_calls_per_s": 10}, rate), 1) == machines


def test_a_load_within_a_tenth_of_the_target_changes_nothing() -> None:
    assert decided(loaded({"max": 5, "target_calls_per_s": 10}, 21), 2) == 2


def test_slow_calls_bring_machines_at_most_twice_as_many_at_once() -> None:
    assert decided(loaded({"max": 9, "target_ms": 100}, 5, ms=150), 2) == 3
    assert decided(loaded({"max": 9, "target_ms": 100}, 5, ms=5_000), 2) == 4


def test_machines_stay_for_five_minutes_after_the_load_is_gone() -> None:
    scaler = loaded({"max": 5, "target_calls_per_s": 10}, 30)
    assert decided(scaler, 1) == 3
    for step in range(1, 200):
        scaler.observe(CallCounts(900, 9_000), at(0, 12) + 30 + 2 * step)
    assert decided(scaler, 3, after_s=200) == 3
    assert decided(scaler, 3, after_s=340) == 1


def test_an_unknown_load_changes_nothing() -> None:
    scaler = loaded({"max": 5, "target_calls_per_s": 10}, 30)
    scaler.observe(None, at(0, 12) + 31)
    assert decided(scaler, 2, after_s=32) == 2


def test_a_proxy_that_began_again_is_measured_from_its_start() -> None:
    scaler = loaded({"max": 5, "target_calls_per_s": 10}, 30)
    scaler.observe(CallCounts(0, 0.0), at(0, 12) + 32)
    assert decided(scaler, 2, after_s=33) == 2


def test_a_budget_bounds_even_the_schedule_and_leaves_one_machine() -> None:
    keys = {"max": 5, "target_calls_per_s": 10, "budget_usd_per_h": 0.5}
    assert decided(loaded(keys, 200), 1, usd=0.2) == 2
    assert decided(loaded({**keys, "min": 4}, 0), 4, usd=0.1) == 4
    assert decided(loaded({**keys, "min": 4}, 0), 4, usd=1.0) == 1


def test_with_a_budget_the_first_machine_shows_the_price() -> None:
    assert decided(loaded({"max": 5, "min": 4, "budget_usd_per_h": 0.5}, 0), 4) == 1


@pytest.mark.parametrize(
    ("day", "hour", "least"), [(0, 7.9, 1), (0, 8.0, 3), (4, 17.9, 3), (4, 18.0, 1), (5, 12, 1), (5, 23, 2), (6, 1, 2)]
)
def test_a_schedule_raises_the_minimum_in_its_hours(day: int, hour: float, least: int) -> None:
    schedule = [
        {"days": "mon-fri", "from": "08:00", "to": "18:00", "min": 3},
        {"days": ["sat"], "from": "22:00", "to": "02:00", "min": 2},
    ]
    policy = policy_from_keys({"min": 1, "max": 4, "schedule": schedule})
    assert policy.least(at(day, hour)) == least
    assert Autoscaler(policy).decide(1, None, at(day, hour)) == least


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({}, "scale: max: expected a whole number from 1 to 1000, not None"),
        ({"max": 2, "min": 3}, "min 3 is above max 2"),
        ({"max": 2, "most": 3}, "most: unknown; expected some of min, max"),
        ({"max": 2, "target_ms": 0}, "target_ms: expected a number above 0, not 0"),
        ({"max": 2, "schedule": [{"from": "8", "to": "18:00", "min": 1}]}, "from '8': expected a time in UTC"),
        ({"max": 2, "schedule": [{"from": "08:00", "to": "09:00", "min": 1, "days": "weekend"}]}, "days 'weekend'"),
    ],
)
def test_a_wrong_policy_says_what_is_expected(keys: dict[str, object], error: str) -> None:
    with pytest.raises(LocalError) as refused:
        policy_from_keys(keys)
    assert error in str(refused.value)


def test_a_plan_keeps_its_policy_in_the_journal() -> None:
    keys = {
        "max": 5,
        "min": 2,
        "target_ms": 50.0,
        "schedule": [{"days": ["fri"], "from": "08:00", "to": "24:00", "min": 3}],
    }
    plan = ClusterPlan("c", (CloudNode("p", "e"),), (SPOT,), scale=policy_from_keys(keys))
    assert ClusterPlan.from_json(plan.to_json()) == plan


def test_a_plan_grows_by_machines_like_its_last_one() -> None:
    plan = ClusterPlan("c", (CloudNode("p", "e"),), (SPOT, SPOT))
    assert plan.resized(3) == (SPOT, SPOT, SPOT)
    assert plan.resized(1) == (SPOT,)
