"""Throttle of one subscription: a shortest time between messages, and a queue for those that come in between.

Sans-I/O. Source: the rosbridge v2 protocol, ``subscribe``: ``throttle_rate`` and ``queue_length``.
"""

from __future__ import annotations

from collections import deque


class Throttle:
    """Passes a message at most every ``period_s`` seconds.

    Args:
        period_s: 0: every message passes at once.
        queue_length: how many of the newest messages wait for their turn; 0: those in between are left out.
    """

    def __init__(self, period_s: float, queue_length: int) -> None:
        self._period_s = period_s
        self._waiting: deque[tuple[int, bytes]] = deque(maxlen=queue_length)
        self._next_s = float("-inf")

    def offer(self, stamp_ns: int, raw: bytes, now_s: float) -> bool:
        """Return whether the message passes now; else it waits or is left out."""
        if not self._waiting and now_s >= self._next_s:
            self._next_s = now_s + self._period_s
            return True
        self._waiting.append((stamp_ns, raw))
        return False

    def get_timer(self) -> float | None:
        """Return when the next waiting message passes; None: none waits."""
        return self._next_s if self._waiting else None

    def poll(self, now_s: float) -> tuple[int, bytes] | None:
        """Return the message whose turn has come, or None."""
        if not self._waiting or now_s < self._next_s:
            return None
        self._next_s = now_s + self._period_s
        return self._waiting.popleft()
