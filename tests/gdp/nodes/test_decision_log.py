"""Decisions of a node in its debug log."""

from __future__ import annotations

import logging

import pytest

from gdp.errors import DropReason
from gdp.names import Name
from gdp.nodes.decision_log import DecisionLog
from gdp.sansio import Timestamps
from gdp.switch.table import Table

_NOW = Timestamps(1.0, 1.0)
_IFNAMES = {3: "eth0"}
_NAME = bytes(range(32))


def test_routes_are_logged_when_they_change_with_device_names(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    table = Table()
    decisions = DecisionLog(_IFNAMES.__getitem__, dict, table)
    table.install(_NAME, ((3, bytes(12)),), 10.0)
    decisions.log_changes(_NOW)
    decisions.log_changes(_NOW)
    table.install(_NAME, (), 10.0)
    decisions.log_changes(_NOW)
    table.remove(_NAME)
    decisions.log_changes(_NOW)
    short = Name(_NAME).short
    assert caplog.messages == [
        f"route set destination={short} source=any to=eth0",
        f"route set destination={short} source=any to=nowhere",
        f"route removed destination={short} source=any",
    ]


def test_drops_are_logged_by_reason_when_there_are_more(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    counts = dict.fromkeys(DropReason, 0)
    decisions = DecisionLog(_IFNAMES.__getitem__, lambda: counts)
    decisions.log_changes(_NOW)
    counts[DropReason.WRONG_DOMAIN] = 4
    decisions.log_changes(_NOW)
    decisions.log_changes(_NOW)
    assert caplog.messages == ["dropped reason=wrong-domain frames=4 total=4"]
