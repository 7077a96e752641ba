"""Reminder schedule of missing connections."""

from __future__ import annotations

from proxy.endpoints.core.reconnect import MissingConnections


def test_a_connection_that_is_made_in_time_is_not_announced_again() -> None:
    missing = MissingConnections[str]()
    assert missing.due({"camera"}, 0.0) == []
    assert missing.due(set(), 1.0) == []
    assert missing.due(set(), 100.0) == []


def test_a_connection_that_stays_missing_is_announced_again_after_a_growing_delay() -> None:
    missing = MissingConnections[str]()
    times_s = [at / 2 for at in range(600) if missing.due({"camera"}, at / 2)]
    assert times_s == [1.5, 4.5, 10.5, 22.5, 46.5, 94.5, 154.5, 214.5, 274.5]


def test_a_connection_that_is_lost_again_begins_with_the_shortest_delay() -> None:
    missing = MissingConnections[str]()
    for at in range(100):
        missing.due({"camera"}, float(at))
    assert missing.due(set(), 100.0) == []
    assert missing.due({"camera"}, 101.0) == []
    assert missing.due({"camera"}, 102.5) == ["camera"]
