"""Best-effort queue: messages of a best-effort topic that have not been sent yet.

Sans-I/O.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from gdp.crypto.envelope import Sealed
from gdp.limits import SEQUENCE_BYTES, WINDOW_BYTES

__all__ = ["BestEffortQueue", "Carried"]


class Carried(NamedTuple):
    """Content of one message number: the count of messages, and the sequence number of the first."""

    number: int
    sequence: int
    messages: int


class BestEffortQueue:
    """Queue of sealed messages, each with its content; when it is full, the oldest are dropped."""

    def __init__(self) -> None:
        self._queue = deque[tuple[Sealed, Carried]]()
        self._held_bytes = 0
        self._part = 0  # of the oldest: the first that has not been sent

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def oldest(self) -> Carried | None:
        """Return the content that is sent next, or None."""
        return self._queue[0][1] if self._queue else None

    def add(self, frames: Sealed, carried: Carried) -> list[Carried]:
        """Queue a message, or a bundle; return what was dropped for it."""
        self._queue.append((frames, carried))
        self._held_bytes += frames.size_bytes
        gone = []
        while self._held_bytes > WINDOW_BYTES and len(self._queue) > 1:
            gone.append(self._let_oldest_go())
        return gone

    def poll_frames(self, limit: int) -> list[bytes]:
        """Return at most ``limit`` frames, in order, sealed as they are taken."""
        frames: list[bytes] = []
        while self._queue and len(frames) < limit:
            oldest, first = self._queue[0][0], self._part
            taken = oldest[first : first + limit - len(frames)]
            frames += taken
            self._part += len(taken)
            if self._part == len(oldest):
                self._let_oldest_go()
        return frames

    def requeue(self, mtu: int) -> list[tuple[bytes, Carried]]:
        """Return everything, to be sealed again, if something is too large for its path; else nothing."""
        if all(frames.largest <= mtu for frames, _ in self._queue):
            return []
        taken = [(frames.message()[SEQUENCE_BYTES:], carried) for frames, carried in self._queue]
        self._queue.clear()
        self._held_bytes = self._part = 0
        return taken

    def _let_oldest_go(self) -> Carried:
        frames, carried = self._queue.popleft()
        self._held_bytes -= frames.size_bytes
        self._part = 0
        return carried
