"""Timers of many objects, each of which is read again only after it may have changed."""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

from gdp.due_queue import DueQueue
from gdp.intervals import NEVER_S


class HasTimer(Protocol):
    """An object that has a timer."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of its next timer, or None."""


T = TypeVar("T", bound=HasTimer)


class TimerQueue(Generic[T]):
    """Timers of many objects.

    Attributes:
        touched: those that may be due at another time than before, in order, so that a run is reproducible.
        due_s: as ``next_due``, while none is touched.
    """

    def __init__(self) -> None:
        self.touched: dict[T, None] = {}
        self.due_s = NEVER_S
        self._queue = DueQueue[T]()

    def next_due(self) -> float:
        """Return the monotonic second at which the first is due; infinity: none is."""
        if self.touched:
            for each in self.touched:
                self._queue.put(each, each.get_timer())
            self.touched = {}
            due_s = self._queue.next_due()
            self.due_s = NEVER_S if due_s is None else due_s
        return self.due_s

    def poll_due(self, now_s: float) -> list[T]:
        """Return the objects that are due; the next check reads their timers again."""
        if self.next_due() > now_s:
            return []
        taken = self._queue.poll_due(now_s)
        for each in taken:
            self.touched[each] = None
        return taken
