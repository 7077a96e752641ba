"""Frames that wait for the answer of a RIB.

Place: pure; time comes in as ``now_s`` (monotonic seconds). Bounded in frames, bytes and time; what does not fit is
counted, never silently lost.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from typing import NamedTuple

from gdp.errors import DropReason
from gdp.limits import PARKED_BYTES_MAX, PARKED_FRAMES_MAX, PARKED_S

__all__ = ["Parked"]


class _Waiting(NamedTuple):
    frame: bytes
    until_s: float


class Parked:
    """Frames by the name whose place they wait for."""

    def __init__(self) -> None:
        self._by_name: OrderedDict[bytes, deque[_Waiting]] = OrderedDict()
        self._frames = 0
        self._bytes = 0
        self.drops: Counter[DropReason] = Counter()

    def __len__(self) -> int:
        return self._frames

    def park(self, name: bytes, frame: bytes, now_s: float, until_s: float | None = None) -> None:
        """Keep a frame until ``release``, or until ``until_s``; if not given, until ``PARKED_S`` have gone."""
        if self._frames >= PARKED_FRAMES_MAX or self._bytes + len(frame) > PARKED_BYTES_MAX:
            self.drops[DropReason.PARKED_FULL] += 1
            return
        waiting = _Waiting(frame, now_s + PARKED_S if until_s is None else until_s)
        self._by_name.setdefault(name, deque()).append(waiting)
        self._frames += 1
        self._bytes += len(frame)

    def is_waiting(self, name: bytes) -> bool:
        """Return whether frames wait for a name."""
        return name in self._by_name

    def release(self, name: bytes) -> list[tuple[bytes, float]]:
        """Return, in order, what waited for a name, and until when each frame would have waited."""
        waiting = self._by_name.pop(name, deque())
        self._frames -= len(waiting)
        self._bytes -= sum(len(each.frame) for each in waiting)
        return [(each.frame, each.until_s) for each in waiting]

    def refuse(self, name: bytes, reason: DropReason) -> None:
        """Drop what waited for a name, under a reason."""
        self.drops[reason] += len(self.release(name))

    def expire(self, now_s: float) -> None:
        """Drop what waited too long."""
        for name in list(self._by_name):
            waiting = self._by_name[name]
            while waiting and waiting[0].until_s <= now_s:
                self._frames -= 1
                self._bytes -= len(waiting.popleft().frame)
                self.drops[DropReason.PARKED_EXPIRED] += 1
            if not waiting:
                del self._by_name[name]

    def next_expiry(self) -> float | None:
        """Return the monotonic second at which the first frame has waited long enough, or None."""
        return min((waiting[0].until_s for waiting in self._by_name.values()), default=None)
