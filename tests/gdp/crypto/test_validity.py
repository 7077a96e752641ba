"""Validity: its first and last second."""

from __future__ import annotations

import pytest

from gdp.crypto.validity import Validity
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CLOCK_SKEW_S

SPAN = Validity(10_000, 20_000)


@pytest.mark.parametrize("unix_s", [10_000 - CLOCK_SKEW_S, 10_000, 15_000.5, 20_000, 20_000 + CLOCK_SKEW_S])
def test_within_the_span_and_the_skew_of_clocks_it_holds(unix_s: float) -> None:
    SPAN.check(unix_s, "it")


@pytest.mark.parametrize("unix_s", [0, 9_999.9 - CLOCK_SKEW_S, 20_000.1 + CLOCK_SKEW_S, 1e12])
def test_beyond_them_it_does_not(unix_s: float) -> None:
    with pytest.raises(StatementError) as caught:
        SPAN.check(unix_s, "it")
    assert caught.value.reason is DropReason.EXPIRED


@pytest.mark.parametrize(("begin", "duration"), [(-1, 10), (0, 0), (0, 0.5), (0, -5)])
def test_a_span_that_cannot_be_is_our_own_mistake(begin: float, duration: float) -> None:
    with pytest.raises(LocalError):
        Validity.lasting(begin, duration)
