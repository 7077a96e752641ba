"""Queue of keys by the second at which each is due; a check costs what has changed, not what waits.

Sans-I/O; time comes in as ``now_s`` (any one clock). Source: Linux hrtimer.

Each key has a heap entry at a time no later than its own. A key whose time moves later keeps its entry until that comes
up. A key that is due sooner gets a second entry, and the first becomes void.
"""

from __future__ import annotations

import heapq
from typing import Any, Final, Generic, TypeVar

from gdp.intervals import NEVER_S

_SLACK: Final = 64  # void entries that are not yet worth a rebuild

K = TypeVar("K")
_Entry = list[Any]  # a list, because it is compared, and its time moves
_PLACE, _RANK, _KEY, _DUE = range(4)  # second at which the heap has it, rank, key, second at which it is due
_VOID: Final = -NEVER_S  # another entry of its key is valid


class DueQueue(Generic[K]):
    """Keys and when each is due.

    Args:
        is_sorted: of keys that are due at once the lowest comes first; else the one that was put first.
    """

    def __init__(self, *, is_sorted: bool = False) -> None:
        self._is_sorted = is_sorted
        self._entries: dict[K, _Entry] = {}  # the valid one of each key
        self._waiting = 0  # entries that are due at some time
        self._heap: list[_Entry] = []
        self._rank = 0

    def __len__(self) -> int:
        return self._waiting

    def __contains__(self, key: K) -> bool:
        return self.due_s(key) < NEVER_S

    def due_s(self, key: K) -> float:
        """Return when a key is due; infinity: it does not wait."""
        entry = self._entries.get(key)
        return NEVER_S if entry is None else float(entry[_DUE])

    def put(self, key: K, at_s: float | None) -> None:
        """Have a key due at a second, instead of when it was before; None or infinity: never."""
        if at_s is None or at_s == NEVER_S:
            self.discard(key)
            return
        if key not in self._entries:
            self._waiting += 1
        else:
            entry = self._entries[key]
            if entry[_DUE] == NEVER_S:
                self._waiting += 1
                self._entries[key] = self._entries.pop(key)  # the order is that in which keys began to wait
            if at_s >= entry[_PLACE]:
                entry[_DUE] = at_s
                return
            entry[_DUE] = _VOID
        self._rank += 1
        entry = self._entries[key] = [at_s, key if self._is_sorted else self._rank, key, at_s]
        heapq.heappush(self._heap, entry)
        if len(self._heap) > 4 * self._waiting + _SLACK:
            self._rebuild()

    def discard(self, key: K) -> None:
        """Remove a key, if it waits."""
        entry = self._entries.get(key)
        if entry is not None and entry[_DUE] != NEVER_S:
            entry[_DUE] = NEVER_S
            self._waiting -= 1

    def clear(self) -> None:
        """Remove every key."""
        self._entries.clear()
        self._heap.clear()
        self._waiting = 0

    def next_due(self) -> float | None:
        """Return when the first key is due, or None."""
        heap = self._heap
        while heap:
            entry = heap[0]
            at_s: float
            due_s: float
            at_s, _, key, due_s = entry
            if due_s == at_s:
                return at_s
            if due_s in (NEVER_S, _VOID):
                heapq.heappop(heap)
                if due_s == NEVER_S:
                    del self._entries[key]
            else:
                self._rank += 1
                entry[_PLACE], entry[_RANK] = due_s, key if self._is_sorted else self._rank
                heapq.heapreplace(heap, entry)
        return None

    def poll_due(self, now_s: float, most: int | None = None) -> list[K]:
        """Remove and return the keys that are due, the first one first."""
        found: list[K] = []
        while (most is None or len(found) < most) and (due_s := self.next_due()) is not None and due_s <= now_s:
            key = heapq.heappop(self._heap)[_KEY]
            del self._entries[key]
            self._waiting -= 1
            found.append(key)
        return found

    def _rebuild(self) -> None:
        """Drop the void entries."""
        waiting = [(each, entry[_DUE]) for each, entry in self._entries.items() if entry[_DUE] != NEVER_S]
        ranked = enumerate(waiting, self._rank + 1)
        self._entries = {each: [at_s, each if self._is_sorted else rank, each, at_s] for rank, (each, at_s) in ranked}
        self._rank += len(waiting)
        self._heap = list(self._entries.values())
        heapq.heapify(self._heap)


def earliest(*moments: float | None) -> float | None:
    """Return the first of some moments, of which None is never."""
    first: float | None = None
    for each in moments:
        if each is not None and (first is None or each < first):
            first = each
    return first
