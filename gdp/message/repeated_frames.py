"""Repeated frames of urgent messages at their reader: which copies are expected, and how long they may take.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/loss.md.

A publisher sends an urgent frame up to ``SENDS_MAX`` times, a few milliseconds apart. A copy within this bound is no
replay. A frame that is missing may come by its copy, so its reader asks for it after ``lag_s``.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from gdp.limits import SENDS_MAX

__all__ = ["REPEATED_PARTS_MAX", "RepeatedFrames"]

REPEATED_PARTS_MAX: Final = 2  # fragments of a message whose frames may be repeated
_KEPT: Final = 512
_COPY_S: Final = 0.25  # a later copy is a replay
_FORGET_S: Final = 1.0  # frames without a copy for this time: they are not repeated any more
_IDLE_S: Final = 0.25  # a pause of the writer, which says nothing of copies
_LAG_MAX_S: Final = 0.025
_SPREAD: Final = 1.25  # of the measured delay: the next one may be longer
_DECAY: Final = 0.9


class RepeatedFrames:
    """Copies of one writer's urgent frames.

    Attributes:
        copies: how many came.
    """

    __slots__ = ("_came", "_first_s", "_lag_s", "_since_s", "copies")

    def __init__(self) -> None:
        self.copies = 0
        self._came: OrderedDict[tuple[int, int], tuple[float, int]] = OrderedDict()  # when it came, and copies of it
        self._first_s = self._since_s = float("-inf")
        self._lag_s = 0.0

    def handle_first(self, number: int, part: int, now_s: float) -> None:
        """Note an urgent fragment that came for the first time."""
        if now_s - self._first_s > _IDLE_S:
            self._since_s = now_s
        self._first_s = now_s
        self._came[number, part] = now_s, 0
        if len(self._came) > _KEPT:
            self._came.popitem(last=False)

    def handle_copy(self, number: int, part: int, now_s: float) -> bool:
        """Return whether a fragment that is here already is a copy that its publisher may have sent; it is counted."""
        came_s, copies = self._came.get((number, part), (float("-inf"), 0))
        if now_s - came_s > _COPY_S or copies >= SENDS_MAX - 1:
            return False
        self._came[number, part] = came_s, copies + 1
        self.copies += 1
        self._since_s = now_s
        self._lag_s = max(min(now_s - came_s, _LAG_MAX_S), self._lag_s * _DECAY)
        return True

    def lag_s(self) -> float:
        """Return how long to wait for the copy of a missing frame; 0 while none come."""
        return _SPREAD * self._lag_s if self._first_s - self._since_s < _FORGET_S else 0.0
