"""Loopback filter: removes the endpoint's own messages from a topic to which it also subscribes.

Sans-I/O; the clock is an argument. rclpy neither ignores local publications nor identifies the sender of a message. So
own messages are recognised by their bytes: as many copies as were published are removed within a short time, from any
sender.
"""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import Final

_MEMORY_S: Final = 2.0
_COUNT_MAX: Final = 4_096
_HEADER: Final = 4  # bytes of encapsulation: an RMW may write its padding there


class LoopbackFilter:
    """A bounded multiset of message hashes; one thread adds, another removes."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._until: dict[int, deque[float]] = {}  # by hash: expiry of each copy
        self._order: deque[tuple[float, int]] = deque()

    def add(self, raw: bytes, now_s: float) -> None:
        """Remember one copy."""
        key = hash(raw[_HEADER:])
        with self._lock:
            self._until.setdefault(key, deque()).append(now_s + _MEMORY_S)
            self._order.append((now_s + _MEMORY_S, key))
            self._forget(now_s)

    def is_loopback(self, raw: bytes, now_s: float) -> bool:
        """Return whether a received message is the endpoint's own; that copy is then removed."""
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
            if copies is not None and copies[0] <= until_s:  # else it was removed before
                copies.popleft()
                if not copies:
                    del self._until[key]
