"""Busy polling: the cases in which it pays before a thread sleeps."""

from __future__ import annotations

from gdp.runtime.busy_poll import BusyPoll


def test_at_first_no_thread_polls() -> None:
    assert not BusyPoll(0.000_3).pays


def test_short_waits_make_it_pay_and_long_ones_end_it() -> None:
    spin = BusyPoll(0.000_3)
    for _ in range(20):
        spin.waited(0.000_1)
    assert spin.pays
    for _ in range(20):
        spin.waited(0.01)
    assert not spin.pays


def test_where_it_is_not_wanted_it_never_pays() -> None:
    spin = BusyPoll(0.0)
    for _ in range(100):
        spin.waited(0.0)
    assert not spin.pays
