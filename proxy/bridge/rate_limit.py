"""How often messages may cross, where a rule limits that.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

__all__ = ["RateLimiter"]


class RateLimiter:
    """Lets so many messages a second pass, evenly; half a period early is in time, for no clock is exact.

    Args:
        max_hz: None: all.
    """

    __slots__ = ("_next_s", "_period_s")

    def __init__(self, max_hz: float | None) -> None:
        self._period_s = None if max_hz is None else 1 / max_hz
        self._next_s = float("-inf")

    def may_pass(self, now_s: float) -> bool:
        """Return whether a message may go now; that counts as one that did."""
        if self._period_s is None:
            return True
        if now_s < self._next_s:
            return False
        self._next_s = max(self._next_s + self._period_s, now_s + self._period_s / 2)
        return True
