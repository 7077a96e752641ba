"""Frames that are pending a name resolution.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: the queue of RFC 4861, section 7.2.2. Bounded in
frames, bytes and time, and shared among the neighbours that sent them; each frame that does not fit is counted.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from typing import NamedTuple

from gdp.errors import DropReason
from gdp.limits import PENDING_BYTES_MAX, PENDING_FRAMES_MAX, PENDING_S
from gdp.message.shares import Shares

__all__ = ["PendingFrames"]


class _PendingFrame(NamedTuple):
    frame: bytes
    until_s: float
    owner: bytes


class PendingFrames:
    """Pending frames, by the name whose location they wait for."""

    def __init__(self) -> None:
        self._by_name: OrderedDict[bytes, deque[_PendingFrame]] = OrderedDict()
        self._frames = Shares(PENDING_FRAMES_MAX)
        self._bytes = Shares(PENDING_BYTES_MAX)
        self.drops: Counter[DropReason] = Counter()

    def __len__(self) -> int:
        return len(self._frames)

    def park(
        self, name: bytes, frame: bytes, now_s: float, until_s: float | None = None, *, owner: bytes = b""
    ) -> None:
        """Store a frame until ``release``, or until ``until_s``; default: for ``PENDING_S``.

        Args:
            owner: the neighbour that it came from.
        """
        if not self._frames.reserve(owner):
            self.drops[DropReason.PENDING_FULL] += 1
            return
        if not self._bytes.reserve(owner, size=len(frame)):
            self._frames.release(owner)
            self.drops[DropReason.PENDING_FULL] += 1
            return
        waiting = _PendingFrame(frame, now_s + PENDING_S if until_s is None else until_s, owner)
        self._by_name.setdefault(name, deque()).append(waiting)

    def release(self, name: bytes) -> list[tuple[bytes, float, bytes]]:
        """Remove and return, in order, the frames that wait for a name, each with its ``until_s`` and owner."""
        waiting = self._by_name.pop(name, deque())
        for each in waiting:
            self._give_back(each)
        return [(each.frame, each.until_s, each.owner) for each in waiting]

    def _give_back(self, waiting: _PendingFrame) -> None:
        self._frames.release(waiting.owner)
        self._bytes.release(waiting.owner, size=len(waiting.frame))

    def drop(self, name: bytes, reason: DropReason) -> None:
        """Drop the frames that wait for a name, under a reason."""
        self.drops[reason] += len(self.release(name))

    def expire(self, now_s: float) -> None:
        """Drop the frames that waited too long."""
        for name in list(self._by_name):
            waiting = self._by_name[name]
            while waiting and waiting[0].until_s <= now_s:
                self._give_back(waiting.popleft())
                self.drops[DropReason.PENDING_EXPIRED] += 1
            if not waiting:
                del self._by_name[name]

    def next_expiry(self) -> float | None:
        """Return the monotonic second at which the first frame has waited long enough, or None."""
        return min((waiting[0].until_s for waiting in self._by_name.values()), default=None)
