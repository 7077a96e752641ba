"""Rate limiter of messages, where a rule sets a maximum rate."""

from __future__ import annotations


class RateLimiter:
    """Passes so many messages a second, evenly; half a period early is in time, because no clock is exact.

    Args:
        max_hz: None: all.
    """

    __slots__ = ("_next_s", "_period_s")

    def __init__(self, max_hz: float | None) -> None:
        self._period_s = None if max_hz is None else 1 / max_hz
        self._next_s = float("-inf")

    def may_pass(self, now_s: float) -> bool:
        """Return whether a message may pass now; True counts it as passed."""
        if self._period_s is None:
            return True
        if now_s < self._next_s:
            return False
        self._next_s = max(self._next_s + self._period_s, now_s + self._period_s / 2)
        return True
