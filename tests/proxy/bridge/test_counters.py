"""Counters of a bridge by direction."""

from __future__ import annotations

from proxy.bridge.counters import Traffic


def test_what_was_carried_is_counted_by_direction() -> None:
    traffic = Traffic()
    for size in (10, 20):
        traffic.sent(size)
    traffic.received(5)
    traffic.unread += 1
    traffic.thinned += 2
    assert traffic.messages() == {"in": 1, "out": 2, "unread": 1, "thinned": 2, "dropped": 0}
    assert traffic.calls() == {"late": 0, "unexpected": 0, "hedged": 0}
    assert traffic.message_bytes() == {"in": 5, "out": 30}
