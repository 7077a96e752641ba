"""Faults of a bridge: each is counted, the first of its kind is logged."""

from __future__ import annotations

import pytest

from proxy.bridge.faults import Fault, Faults


def test_each_is_counted_and_the_first_of_its_kind_reported(caplog: pytest.LogCaptureFixture) -> None:
    faults = Faults()
    for detail in ("first", "second"):
        faults.report("/chatter", Fault.TOO_LARGE, detail)
    faults.report("/chatter", Fault.TOO_FAST, "another")
    faults.report("/other", Fault.TOO_LARGE, "elsewhere")
    assert caplog.messages == [
        "/chatter: too-large: first",
        "/chatter: too-fast: another",
        "/other: too-large: elsewhere",
    ]
    assert (faults.counts["too-large"], faults.counts["too-fast"], faults.total) == (3, 1, 4)


def test_a_cleared_fault_is_reported_again(caplog: pytest.LogCaptureFixture) -> None:
    faults = Faults()
    faults.report("/chatter", Fault.QOS, "first")
    faults.clear("/chatter", Fault.QOS)
    faults.clear("/never", Fault.QOS)
    faults.report("/chatter", Fault.QOS, "again")
    assert caplog.messages == ["/chatter: qos: first", "/chatter: qos: again"]


def test_a_fault_that_recurs_is_reported_at_each_power_of_ten_from_a_thousand_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    faults = Faults()
    for _ in range(20_000):
        faults.report("/chatter", Fault.TOO_LARGE, "each")
    assert caplog.messages == [
        "/chatter: too-large: each",
        "/chatter: too-large: 1000 times by now",
        "/chatter: too-large: 10000 times by now",
    ]


def test_every_fault_has_a_count_from_the_beginning() -> None:
    assert Faults().counts == {fault.value: 0 for fault in Fault}


def test_ever_new_names_do_not_fill_the_memory() -> None:
    faults = Faults()
    for number in range(5_000):
        faults.report(f"/t{number}", Fault.NO_DELEGATION, "")
    assert (faults.total, len(faults._reported)) == (5_000, 4_096)
