"""Second copies of a flow that travels over two paths: how far the slower path is behind the faster one.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/two-paths.md.

What the faster path has lost is not missing yet: the slower one may bring it. A reader asks for it after ``lag_s``.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from gdp.message.acknack import MissingRange

__all__ = ["DeferredRequests", "SecondCopies"]

_KEPT: Final = 256  # messages whose first fragment is remembered until its copy comes
_FORGET_S: Final = 1.0  # fragments without a copy for this time: one path is broken, and nothing is awaited from it
_IDLE_S: Final = 0.25  # a pause of the writer, which says nothing of its paths
_LAG_MAX_S: Final = 0.5  # a path that is further behind is not awaited
_SPREAD: Final = 1.25  # of the lag that was measured: the next one may be longer
_DECAY: Final = 0.9  # of the estimate with each copy that came sooner


class SecondCopies:
    """Delay of the later copies of one writer's fragments."""

    __slots__ = ("_came", "_first_s", "_lag_s", "_since_s")

    def __init__(self) -> None:
        self._came: OrderedDict[int, tuple[int, float]] = OrderedDict()  # by message: a fragment, and when it came
        self._first_s = self._since_s = float("-inf")  # the last first fragment; since when no copy has come
        self._lag_s = 0.0

    def handle_first(self, number: int, part: int, now_s: float) -> None:
        """Note the first fragment that came of a message; later ones of it are ignored."""
        if now_s - self._first_s > _IDLE_S:
            self._since_s = now_s
        self._first_s = now_s
        if number not in self._came:
            self._came[number] = part, now_s
            if len(self._came) > _KEPT:
                self._came.popitem(last=False)

    def handle_copy(self, number: int, part: int, now_s: float) -> None:
        """Note the copy of a fragment that had come before."""
        self._since_s = now_s
        first, came_s = self._came.get(number, (-1, now_s))
        if first == part:
            del self._came[number]
            self._lag_s = max(min(now_s - came_s, _LAG_MAX_S), self._lag_s * _DECAY)

    def lag_s(self) -> float:
        """Return how long to wait for the slower path; 0 while one path brings nothing."""
        return _SPREAD * self._lag_s if self._first_s - self._since_s < _FORGET_S else 0.0


class DeferredRequests:
    """Requests for missing fragments, held back until the slower path has had its time.

    Attributes:
        due_s: monotonic second at which something is no longer held back; infinite while nothing is.
    """

    __slots__ = ("_missing", "_since_s", "due_s")

    def __init__(self) -> None:
        self._missing: tuple[MissingRange, ...] = ()
        self._since_s = 0.0
        self.due_s = float("inf")

    def poll_due(self, missing: tuple[MissingRange, ...], lag_s: float, now_s: float) -> tuple[MissingRange, ...]:
        """Return what of ``missing`` has been missing for ``lag_s`` at least; all of it if that is 0."""
        before = self._missing
        if before and missing and now_s < self._since_s + lag_s:
            self.due_s = self._since_s + lag_s
            return ()
        self._missing, self._since_s = missing, now_s
        is_held = bool(missing) and lag_s > 0
        due = tuple(both for a in missing for b in before if (both := _overlap(a, b))) if is_held else missing
        self.due_s = now_s + lag_s if is_held and not due else float("inf")
        return due


def _overlap(a: MissingRange, b: MissingRange) -> MissingRange | None:
    first, last = max(a.first, b.first), min(a.last, b.last)
    return MissingRange(a.number, first, last) if a.number == b.number and first <= last else None
