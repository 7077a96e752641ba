"""Copies of frames at their reader: how far they are behind the frames that came first, and which ones are expected.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Sources: docs/explanation/loss.md and two-paths.md.

A frame that is missing may come by its copy: by the slower of two paths, or a few milliseconds later by the same one.
A reader asks for it after ``lag_s``.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from gdp.limits import PATH_LAG_MAX_S, SENDS_MAX
from gdp.message.acknack import MissingRange

REPEATED_PARTS_MAX: Final = 2  # fragments of a message whose frames may be repeated over one path
_KEPT_MESSAGES, _KEPT_FRAMES = 256, 512  # that are remembered until their copies come
_FORGET_S: Final = 1.0  # frames without a copy for this time: no copies are sent, or one path is broken
_IDLE_S: Final = 0.25  # a pause of the writer, which says nothing of its paths
_REPEATED_MAX_S: Final = 0.025
_REPLAY_S: Final = 0.25  # a later copy over one path is a replay
_SPREAD: Final = 1.25  # of the lag that was measured: the next one may be longer
_DECAY: Final = 0.9  # of the estimate with each copy that came sooner


class _CopyDelay:
    """Estimate of the delay of copies, of at most ``most_s``."""

    __slots__ = ("_first_s", "_lag_s", "_most_s", "_since_s")

    def __init__(self, most_s: float) -> None:
        self._most_s = most_s
        self._first_s = self._since_s = float("-inf")  # the last first frame; since when no copy has come
        self._lag_s = 0.0

    def _note_first(self, now_s: float) -> None:
        if now_s - self._first_s > _IDLE_S:
            self._since_s = now_s
        self._first_s = now_s

    def _measure(self, delay_s: float) -> None:
        self._lag_s = max(min(delay_s, self._most_s), self._lag_s * _DECAY)

    def lag_s(self) -> float:
        """Return how long to wait for the copy of a missing frame; 0 while none come."""
        return _SPREAD * self._lag_s if self._first_s - self._since_s < _FORGET_S else 0.0


class SecondCopies(_CopyDelay):
    """Copies of all frames of one writer, which travel over two paths: of each message one fragment is measured."""

    __slots__ = ("_came",)

    def __init__(self) -> None:
        super().__init__(PATH_LAG_MAX_S)
        self._came: OrderedDict[int, tuple[int, float]] = OrderedDict()  # by message: a fragment, and when it came

    def handle_first(self, number: int, part: int, now_s: float) -> None:
        """Note the first fragment that came of a message; later ones of it are ignored."""
        self._note_first(now_s)
        if number not in self._came:
            self._came[number] = part, now_s
            if len(self._came) > _KEPT_MESSAGES:
                self._came.popitem(last=False)

    def handle_copy(self, number: int, part: int, now_s: float) -> None:
        """Note the copy of a fragment that had come before."""
        self._since_s = now_s
        first, came_s = self._came.get(number, (-1, now_s))
        if first == part:
            del self._came[number]
            self._measure(now_s - came_s)


class RepeatedFrames(_CopyDelay):
    """Copies of one writer's urgent frames over one path: up to ``SENDS_MAX`` sendings, a few milliseconds apart.

    Attributes:
        copies: how many came.
    """

    __slots__ = ("_came", "copies")

    def __init__(self) -> None:
        super().__init__(_REPEATED_MAX_S)
        self.copies = 0
        self._came: OrderedDict[tuple[int, int], tuple[float, int]] = OrderedDict()  # when it came, and copies of it

    def handle_first(self, number: int, part: int, now_s: float) -> None:
        """Note an urgent fragment that came for the first time."""
        self._note_first(now_s)
        self._came[number, part] = now_s, 0
        if len(self._came) > _KEPT_FRAMES:
            self._came.popitem(last=False)

    def handle_copy(self, number: int, part: int, now_s: float) -> bool:
        """Return whether a fragment that is here already is a copy that its publisher may have sent; it is counted."""
        came_s, copies = self._came.get((number, part), (float("-inf"), 0))
        if now_s - came_s > _REPLAY_S or copies >= SENDS_MAX - 1:
            return False
        self._came[number, part] = came_s, copies + 1
        self.copies += 1
        self._since_s = now_s
        self._measure(now_s - came_s)
        return True


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
