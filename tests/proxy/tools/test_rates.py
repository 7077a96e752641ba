"""Rates of a topic, as ``ros2 topic hz`` and ``ros2 topic bw`` state them."""

from __future__ import annotations

import pytest

from proxy.tools.rates import Bandwidth, Frequency


def test_the_rate_is_that_of_the_gaps_between_messages() -> None:
    measured = Frequency(100)
    for now_s in (0.0, 0.1, 0.3):
        measured.add(now_s)
    report = measured.poll_report()
    assert report is not None
    assert report == pytest.approx((1 / 0.15, 0.1, 0.2, 0.05, 3))
    assert report.words().startswith("average rate: 6.667\n\tmin: 0.100s max: 0.200s std dev: 0.05000s window: 3")


def test_there_is_no_report_without_a_new_message() -> None:
    measured = Frequency(100)
    measured.add(0.0)
    assert measured.poll_report() is None
    measured.add(1.0)
    assert measured.poll_report() is not None
    assert measured.poll_report() is None


def test_the_window_forgets_the_oldest_messages() -> None:
    measured = Frequency(2)
    for now_s in (0.0, 10.0, 10.5):
        measured.add(now_s)
    report = measured.poll_report()
    assert report is not None
    assert (report.rate_hz, report.window) == (2.0, 2)


def test_bandwidth_is_the_bytes_since_the_first_message() -> None:
    measured = Bandwidth(100)
    measured.add(0.0, 1_000)
    measured.add(1.0, 3_000)
    report = measured.poll_report(2.0)
    assert report == (2_000.0, 2, 2_000.0, 1_000, 3_000)
    assert report.words() == "2.00 KB/s from 2 messages\n\tMessage size mean: 2.00 KB min: 1.00 KB max: 3.00 KB"
