"""Bounded queue of frames that wait for a slow TLS connection.

Sans-I/O. An unbounded queue in front of a slow link turns congestion into delay (bufferbloat; RFC 7567, section 1), so
the bound is in bytes and small. Frames of neighbours and urgent frames leave first. If the queue is full, the oldest
best-effort frame gives way, because its reader wants the newest. Otherwise the new frame is dropped: the reliable
streams retransmit it and lower their rate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from gdp.frame.codec import CONTROL_FROM, ETHER_BYTES, FLAGS_AT, KIND_AT, Flag

_KIND: Final = ETHER_BYTES + KIND_AT
_FLAGS: Final = ETHER_BYTES + FLAGS_AT
_RELIABLE: Final = int(Flag.RELIABLE)
_URGENT: Final = int(Flag.URGENT)
_PER_FRAME_BYTES: Final = 2


class FrameQueue:
    """Frames in order of their class: urgent, then all others.

    Args:
        limit_bytes: bytes held at most.

    Attributes:
        held_bytes: bytes held now, with the prefix of each frame.
        dropped: frames that did not fit.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._urgent: deque[bytes] = deque()
        self._others: deque[tuple[int, bytes]] = deque()  # reliable: number in order of arrival, frame
        self._best_effort: deque[tuple[int, bytes]] = deque()
        self._arrivals = 0
        self.held_bytes = 0
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._urgent) + len(self._others) + len(self._best_effort)

    def put(self, frame: bytes) -> None:
        """Add a frame that ``is_gdp_frame``; if the queue is full, this one or older ones are dropped and counted."""
        flags = frame[_FLAGS]
        is_urgent = frame[_KIND] >= CONTROL_FROM or flags & _URGENT
        size = len(frame) + _PER_FRAME_BYTES
        if self.held_bytes + size > self._limit_bytes and not self._make_space(size):
            self.dropped += 1
            return
        self.held_bytes += size
        if is_urgent:
            self._urgent.append(frame)
            return
        self._arrivals += 1
        (self._others if flags & _RELIABLE else self._best_effort).append((self._arrivals, frame))

    def take(self, budget_bytes: int) -> list[bytes]:
        """Remove and return the next frames, together at most ``budget_bytes`` with their prefixes, but at least one.

        Returns nothing if the queue is empty.
        """
        taken: list[bytes] = []
        left = budget_bytes
        urgent, others, best_effort = self._urgent, self._others, self._best_effort
        while True:
            remove: Callable[[], bytes | tuple[int, bytes]]
            if urgent:
                frame, remove = urgent[0], urgent.popleft
            elif others and (not best_effort or others[0][0] < best_effort[0][0]):
                frame, remove = others[0][1], others.popleft
            elif best_effort:
                frame, remove = best_effort[0][1], best_effort.popleft
            else:
                break
            size = len(frame) + _PER_FRAME_BYTES
            if size > left and taken:
                break
            remove()
            taken.append(frame)
            left -= size
        self.held_bytes -= budget_bytes - left
        return taken

    def clear(self) -> None:
        """Drop and count all frames, because the connection has ended."""
        self.dropped += len(self)
        self.held_bytes = 0
        self._urgent.clear()
        self._others.clear()
        self._best_effort.clear()

    def _make_space(self, size: int) -> bool:
        while self._best_effort and self.held_bytes + size > self._limit_bytes:
            _, oldest = self._best_effort.popleft()
            self.held_bytes -= len(oldest) + _PER_FRAME_BYTES
            self.dropped += 1
        return self.held_bytes + size <= self._limit_bytes
