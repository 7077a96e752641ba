"""Rate limit of a rule."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from proxy.bridge.rate_limit import RateLimiter


@given(st.floats(0.5, 500), st.lists(st.floats(0.0001, 0.5), min_size=1, max_size=300))
def test_no_more_than_the_rule_says_pass_whatever_comes(max_hz: float, gaps: list[float]) -> None:
    pace, now_s, passed = RateLimiter(max_hz), 1_000.0, list[float]()
    for gap in gaps:
        now_s += gap
        if pace.may_pass(now_s):
            passed.append(now_s)
    assert len(passed) <= (now_s - passed[0]) * max_hz + 2
    assert all(after - before >= 0.499 / max_hz for before, after in pairwise(passed))


@pytest.mark.parametrize("max_hz", [1.0, 10.0, 30.0])
def test_what_is_no_faster_passes_whole_though_it_jitters(max_hz: float) -> None:
    pace = RateLimiter(max_hz)
    assert all(pace.may_pass(1_000 + (number + 0.2 * (-1) ** number) / max_hz) for number in range(1_000))


def test_without_a_limit_all_pass() -> None:
    pace = RateLimiter(None)
    assert all(pace.may_pass(1.0) for _ in range(100))
