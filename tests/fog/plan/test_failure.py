"""Replica count for a target availability, with the worked example of FogROS2-FT."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog.plan.duration import duration_text, seconds_from_text
from fog.plan.failure import (
    chance_down,
    joint,
    joint_in_one_region,
    joint_over_regions,
    more_in_one_region,
    replicas_needed,
)
from fog.plan.mix import Kind, cheapest_mix
from gdp.errors import LocalError

chances = st.floats(0.0001, 0.9)


def test_the_papers_worked_example_takes_two_spot_machines() -> None:
    down = chance_down(15 * 3600, 20 * 60)
    assert down == pytest.approx(0.0217, abs=5e-5)
    assert replicas_needed(down, 0.0005) == 2
    assert joint([down, down]) < 0.0005 < down


@given(chances, st.floats(1e-9, 0.99))
def test_the_fewest_replicas_reach_the_target_and_one_less_does_not(machine: float, target: float) -> None:
    count = replicas_needed(machine, target)
    assert machine**count <= target * (1 + 1e-6)
    assert count == 1 or machine ** (count - 1) > target


def test_a_target_that_is_a_whole_power_needs_no_further_replica() -> None:
    assert replicas_needed(0.1, 0.001) == 3


@pytest.mark.parametrize(("machine", "target"), [(0.0, 0.1), (1.0, 0.1), (0.1, 0.0), (0.1, 1.0), (0.1, 2.0)])
def test_chances_outside_nought_and_one_are_refused(machine: float, target: float) -> None:
    with pytest.raises(LocalError):
        replicas_needed(machine, target)


def test_a_machine_that_never_stays_or_recovers_is_refused() -> None:
    for uptime_s, recovery_s in ((0, 1), (1, 0), (float("inf"), 1)):
        with pytest.raises(LocalError):
            chance_down(uptime_s, recovery_s)


@given(st.lists(chances, max_size=5))
def test_a_factor_of_one_is_independence(machines: list[float]) -> None:
    assert joint_in_one_region(machines, 1.0) == pytest.approx(joint(machines))


@given(st.lists(chances, min_size=1, max_size=5), st.floats(1.0, 50.0))
def test_failing_together_is_never_better_than_independent_nor_worse_than_one(
    machines: list[float], factor: float
) -> None:
    together = joint_in_one_region(machines, factor)
    assert joint(machines) * (1 - 1e-9) <= together <= max(machines)


@given(chances, st.floats(1e-9, 0.9), st.floats(1.0, 20.0), st.lists(chances, max_size=3))
def test_what_is_added_in_one_region_reaches_the_target_or_nothing_would(
    machine: float, target: float, factor: float, have: list[float]
) -> None:
    more = more_in_one_region(machine, target, factor, have)
    if more is None:
        assert joint_in_one_region([*have, *[machine] * 400], factor) > target
    else:
        assert joint_in_one_region([*have, *[machine] * more], factor) <= target
        assert more == 0 or joint_in_one_region([*have, *[machine] * (more - 1)], factor) > target


def test_different_regions_multiply() -> None:
    assert joint_over_regions({"a": [0.1, 0.1], "b": [0.1]}, 3.0) == pytest.approx(0.1 * 0.3 * 0.1)


def test_a_factor_below_one_is_refused() -> None:
    with pytest.raises(LocalError):
        joint_in_one_region([0.1], 0.5)


def test_the_cheapest_mix_takes_the_dearer_machine_only_where_it_saves_money() -> None:
    spot, steady = Kind("spot", 0.1, 1.0), Kind("on-demand", 0.001, 2.5)
    assert cheapest_mix((spot, steady), 0.01).more == (2, 0)
    assert cheapest_mix((spot, steady), 0.001).more == (0, 1)
    assert cheapest_mix((spot, steady), 0.0001).more == (1, 1)


def test_machines_that_run_already_count() -> None:
    spot = Kind("spot", 0.1, 1.0)
    assert cheapest_mix((spot,), 0.001, have=[0.1, 0.1]).more == (1,)
    assert cheapest_mix((spot,), 0.001, have=[0.0001]).more == (0,)
    assert cheapest_mix((spot,), 0.5, have=[0.1]).more == (0,)


@pytest.mark.parametrize(
    ("text", "seconds"), [("15h", 54000), ("20min", 1200), ("90s", 90), ("1h30min", 5400), ("0.5d", 43200), ("7", 7)]
)
def test_a_span_of_time_is_read(text: str, seconds: float) -> None:
    assert seconds_from_text(text) == seconds


@pytest.mark.parametrize("text", ["", "h", "15 h", "-1s", "1s1h", "15hours", "1e3s"])
def test_what_is_no_span_of_time_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="span of time"):
        seconds_from_text(text)


@given(st.floats(0.01, 1e7))
def test_a_span_is_written_as_it_is_read(seconds: float) -> None:
    assert seconds_from_text(duration_text(round(seconds, 2))) == pytest.approx(seconds, rel=0.01, abs=0.01)
