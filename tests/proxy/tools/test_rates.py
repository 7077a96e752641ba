"""Rates of a topic, as ``ros2 topic hz`` and ``ros2 topic bw`` state them."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from proxy.tools.rates import Arrivals, Bandwidth, Frequency


def _frequency(window: int, times_s: Sequence[float]) -> Frequency:
    arrivals = Arrivals(window)
    for now_s in times_s:
        arrivals.add(now_s, 1)
    return Frequency.of(arrivals.poll_latest(), times_s[-1])


def test_the_rate_is_that_of_the_gaps_between_messages() -> None:
    report = _frequency(100, (0.0, 0.1, 0.3))
    assert report == pytest.approx((1 / 0.15, 0.1, 0.2, 0.05, 3))
    assert report.words().startswith("average rate: 6.667\n\tmin: 0.100s max: 0.200s std dev: 0.05000s window: 3")


def test_there_is_no_report_without_a_new_message() -> None:
    arrivals = Arrivals(100)
    arrivals.add(0.0, 1)
    assert not arrivals.poll_latest()
    arrivals.add(1.0, 1)
    assert arrivals.poll_latest()
    assert not arrivals.poll_latest()


def test_the_window_forgets_the_oldest_messages() -> None:
    report = _frequency(2, (0.0, 10.0, 10.5))
    assert (report.rate_hz, report.window) == (2.0, 2)


def test_bandwidth_is_the_bytes_since_the_first_message() -> None:
    arrivals = Arrivals(100)
    arrivals.add(0.0, 1_000)
    arrivals.add(1.0, 3_000)
    report = Bandwidth.of(arrivals.poll_latest(), 2.0)
    assert report == (2_000.0, 2, 2_000.0, 1_000, 3_000)
    assert report.words() == "2.00 KB/s from 2 messages\n\tMessage size mean: 2.00 KB min: 1.00 KB max: 3.00 KB"
