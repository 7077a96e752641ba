"""Queue of keys by the second at which each is due; a check costs what has changed, not what waits.

Sans-I/O; time comes in as ``now_s`` (any one clock). Source: Linux hrtimer.

Each key has a heap entry at a time no later than its own. A key whose time moves later keeps its entry until that comes
up. A key that is due sooner gets a second entry, and the first becomes void.
"""

from __future__ import annotations

import heapq
from itertools import count
from typing import Any, Final, Generic, TypeVar

from gdp.intervals import NEVER_S

__all__ = ["DueQueue", "earliest"]

_SLACK: Final = 64  # void entries that are not yet worth a rebuild

K = TypeVar("K")


class DueQueue(Generic[K]):
    """Keys and when each is due.

    Args:
        is_sorted: of keys that are due at once the lowest comes first; else the one that was put first.
    """

    def __init__(self, *, is_sorted: bool = False) -> None:
        self._is_sorted = is_sorted
        self._due_s: dict[K, float] = {}
        self._place_s: dict[K, float] = {}  # time of its valid heap entry
        self._heap: list[tuple[float, Any, K]] = []
        self._order = count()

    def __len__(self) -> int:
        return len(self._due_s)

    def __contains__(self, key: K) -> bool:
        return key in self._due_s

    def due_s(self, key: K) -> float:
        """Return when a key is due; infinity: it does not wait."""
        return self._due_s.get(key, NEVER_S)

    def put(self, key: K, at_s: float | None) -> None:
        """Have a key due at a second, instead of when it was before; None or infinity: never."""
        if at_s is None or at_s == NEVER_S:
            self.discard(key)
            return
        self._due_s[key] = at_s
        if at_s < self._place_s.get(key, NEVER_S):
            self._stand(key, at_s)

    def discard(self, key: K) -> None:
        """Remove a key, if it waits."""
        self._due_s.pop(key, None)

    def clear(self) -> None:
        """Remove every key."""
        for each in (self._due_s, self._place_s, self._heap):
            each.clear()

    def next_due(self) -> float | None:
        """Return when the first key is due, or None."""
        while self._heap:
            at_s, _, key = self._heap[0]
            due_s = self._due_s.get(key)
            if self._place_s.get(key) == at_s == due_s:
                return at_s
            heapq.heappop(self._heap)
            if self._place_s.get(key) == at_s:
                del self._place_s[key]
                if due_s is not None:
                    self._stand(key, due_s)
        return None

    def poll_due(self, now_s: float, most: int | None = None) -> list[K]:
        """Remove and return the keys that are due, the first one first."""
        found: list[K] = []
        while (most is None or len(found) < most) and (due_s := self.next_due()) is not None and due_s <= now_s:
            key = heapq.heappop(self._heap)[2]
            del self._place_s[key], self._due_s[key]
            found.append(key)
        return found

    def _stand(self, key: K, at_s: float) -> None:
        self._place_s[key] = at_s
        heapq.heappush(self._heap, (at_s, self._rank(key), key))
        if len(self._heap) > 4 * len(self._due_s) + _SLACK:
            self._place_s = dict(self._due_s)
            self._heap = [(due_s, self._rank(each), each) for each, due_s in self._due_s.items()]
            heapq.heapify(self._heap)

    def _rank(self, key: K) -> Any:
        return key if self._is_sorted else next(self._order)


def earliest(*moments: float | None) -> float | None:
    """Return the first of some moments, of which None is never."""
    first: float | None = None
    for each in moments:
        if each is not None and (first is None or each < first):
            first = each
    return first
