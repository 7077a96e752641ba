"""What this endpoint published on a topic that it hears too, so that it does not hear itself.

Place: pure; the clock is an argument. rclpy neither ignores local publications nor says who sent a message, so its own
are known by their bytes: as many copies as were published are taken out, within a short time, whoever sent them.
"""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import Final

__all__ = ["LoopbackFilter"]

_MEMORY_S: Final = 2.0
_COUNT_MAX: Final = 4_096
_HEADER: Final = 4  # of encapsulation: an RMW may write its padding there


class LoopbackFilter:
    """A bounded multiset of message hashes; one thread adds, another takes out."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._until: dict[int, deque[float]] = {}  # by hash: when each copy is forgotten
        self._order: deque[tuple[float, int]] = deque()

    def add(self, raw: bytes, now_s: float) -> None:
        """Remember one copy."""
        key = hash(raw[_HEADER:])
        with self._lock:
            self._until.setdefault(key, deque()).append(now_s + _MEMORY_S)
            self._order.append((now_s + _MEMORY_S, key))
            self._forget(now_s)

    def is_loopback(self, raw: bytes, now_s: float) -> bool:
        """Return whether a message that came is one of ours; that copy of it is then spent."""
        with self._lock:
            self._forget(now_s)
            if not self._until:
                return False
            key = hash(raw[_HEADER:])
            copies = self._until.get(key)
            if copies is None:
                return False
            copies.popleft()
            if not copies:
                del self._until[key]
            return True

    def _forget(self, now_s: float) -> None:
        while self._order and (self._order[0][0] <= now_s or len(self._order) > _COUNT_MAX):
            until_s, key = self._order.popleft()
            copies = self._until.get(key)
            if copies is not None and copies[0] <= until_s:  # else it was taken out before
                copies.popleft()
                if not copies:
                    del self._until[key]
