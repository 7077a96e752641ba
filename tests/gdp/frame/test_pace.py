"""Paces and the rates that they stand for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.frame.pace import kbit_s_of, pace_of
from gdp.limits import PACE_MAX


@pytest.mark.parametrize(
    ("bytes_s", "pace", "kbit_s"), [(0.0, 1, 9), (1_000.0, 1, 9), (125_000.0, 28, 1_020), (12_500_000.0, 54, 92_700)]
)
def test_a_rate_has_a_pace_and_a_pace_its_rate(bytes_s: float, pace: int, kbit_s: int) -> None:
    assert (pace_of(bytes_s), kbit_s_of(pace)) == (pace, kbit_s)


@given(st.floats(1_200.0, 1e12))
def test_the_rate_of_a_pace_is_within_a_tenth(bytes_s: float) -> None:
    rate = kbit_s_of(pace_of(bytes_s))
    assert rate is not None
    assert abs(rate - bytes_s * 8e-3) <= 0.1 * bytes_s * 8e-3 + 1


def test_the_highest_pace_is_no_rate() -> None:
    assert kbit_s_of(PACE_MAX) is None
    assert pace_of(1e30) < PACE_MAX
