"""Timer queue with lazy rescheduling: the cost of a check is proportional to the timers that changed.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: Linux hrtimer.

Each object has a heap entry at a time no later than its timer. An object whose timer moves later keeps its entry until
that comes up. An object that is due sooner gets a second entry, and the first becomes void.
"""

from __future__ import annotations

import heapq
from itertools import count
from typing import Final, Generic, Protocol, TypeVar

__all__ = ["HasTimer", "TimerQueue"]


_NEVER: Final = float("inf")


class HasTimer(Protocol):
    """An object that has a timer."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of its next timer, or None."""


T = TypeVar("T", bound=HasTimer)


class TimerQueue(Generic[T]):
    """Timers of many objects."""

    def __init__(self) -> None:
        self._touched: dict[T, None] = {}  # in order, so that a run is reproducible
        self._due_s: dict[T, float] = {}
        self._place_s: dict[T, float] = {}  # time of its valid heap entry
        self._heap: list[tuple[float, int, T]] = []
        self._order = count()

    def reschedule(self, each: T) -> None:
        """Note that an object may be due at another time than before."""
        self._touched[each] = None

    def next_due(self) -> float | None:
        """Return the monotonic second at which the first is due, or None."""
        self._refresh()
        while self._heap:
            at_s, _, each = self._heap[0]
            due_s = self._due_s.get(each)
            if self._place_s.get(each) == at_s == due_s:
                return at_s
            heapq.heappop(self._heap)
            if self._place_s.get(each) == at_s:
                del self._place_s[each]
                if due_s is not None:
                    self._stand(each, due_s)
        return None

    def poll_due(self, now_s: float) -> list[T]:
        """Return the objects that are due; the next check reads their timers again."""
        taken: list[T] = []
        while (due_s := self.next_due()) is not None and due_s <= now_s:
            each = heapq.heappop(self._heap)[2]
            del self._place_s[each], self._due_s[each]
            taken.append(each)
        self._touched.update(dict.fromkeys(taken))
        return taken

    def _refresh(self) -> None:
        for each in self._touched:
            due_s = each.get_timer()
            if due_s is None or due_s == _NEVER:
                self._due_s.pop(each, None)
                continue
            self._due_s[each] = due_s
            if due_s < self._place_s.get(each, _NEVER):
                self._stand(each, due_s)
        self._touched.clear()

    def _stand(self, each: T, at_s: float) -> None:
        self._place_s[each] = at_s
        heapq.heappush(self._heap, (at_s, next(self._order), each))
