"""Timers of many objects, each of which is read again only after it may have changed.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

from gdp.due_queue import DueQueue

__all__ = ["HasTimer", "TimerQueue"]


class HasTimer(Protocol):
    """An object that has a timer."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of its next timer, or None."""


T = TypeVar("T", bound=HasTimer)


class TimerQueue(Generic[T]):
    """Timers of many objects."""

    def __init__(self) -> None:
        self._touched: dict[T, None] = {}  # in order, so that a run is reproducible
        self._queue = DueQueue[T]()
        self._due_s: float | None = None  # while nothing is touched

    def reschedule(self, each: T) -> None:
        """Note that an object may be due at another time than before."""
        self._touched[each] = None

    def next_due(self) -> float | None:
        """Return the monotonic second at which the first is due, or None."""
        if self._touched:
            for each in self._touched:
                self._queue.put(each, each.get_timer())
            self._touched.clear()
            self._due_s = self._queue.next_due()
        return self._due_s

    def poll_due(self, now_s: float) -> list[T]:
        """Return the objects that are due; the next check reads their timers again."""
        due_s = self.next_due()
        taken = self._queue.poll_due(now_s) if due_s is not None and due_s <= now_s else []
        self._touched.update(dict.fromkeys(taken))
        return taken
