"""Loss of frames on the way to the readers of one publisher, from the frames sent and those that each reader counted.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A reader counts every frame that came, copies included. So the estimate shows what the path loses, also while copies
and repairs hide it from the messages. The share decays over ``_MEMORY_FRAMES``.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Container, Iterable
from dataclasses import dataclass
from math import exp
from typing import Final

from gdp.frame.codec import NUMBER_AT
from gdp.intervals import PACE_S
from gdp.message.acknack import FRAMES_MASK

_MEMORY_FRAMES: Final = 1_000
_LEAST_FRAMES: Final = 64  # before this many were reported, nothing is known
_MARKS_MAX: Final = 16_384  # message numbers whose place among the sent frames is remembered
_NUMBER: Final = slice(NUMBER_AT, NUMBER_AT + 8)
_BACKWARDS: Final = FRAMES_MASK >> 1  # a larger step is a count that began again


@dataclass(slots=True)
class _ReaderCount:
    sent_at: int
    received: int
    sent: float = 0.0  # decayed
    lost: float = 0.0

    @property
    def loss(self) -> float:
        return min(max(self.lost / self.sent, 0.0), 1.0)


class FrameLoss:
    """Loss estimate of one publisher's frames: the highest of its readers."""

    def __init__(self) -> None:
        self._sent = 0
        self._numbers: list[int] = []  # rising
        self._sent_before: list[int] = []
        self._readers: dict[bytes, _ReaderCount] = {}
        self._loss: float | None = None
        self._is_stale = False
        self._next_s = float("-inf")

    def handle_sent(self, frames: Iterable[bytes]) -> None:
        """Count DATA frames that leave now; the message numbers of copies and repairs are lower than others."""
        marks = self._numbers
        for frame in frames:
            number = int.from_bytes(frame[_NUMBER], "big")
            if not marks or number > marks[-1]:
                marks.append(number)
                self._sent_before.append(self._sent)
            self._sent += 1
        if len(marks) > _MARKS_MAX:
            del marks[: _MARKS_MAX // 2], self._sent_before[: _MARKS_MAX // 2]

    def handle_report(self, reader: bytes, next_number: int, next_part: int, received: int) -> None:
        """Compare a reader's count with the frames that were sent before the first one it lacks."""
        place = bisect_left(self._numbers, next_number)
        if place == 0:
            return
        sent_at = self._sent
        if place < len(self._numbers):
            sent_at = min(self._sent_before[place] + (next_part if self._numbers[place] == next_number else 0), sent_at)
        count = self._readers.get(reader)
        came = 0 if count is None else (received - count.received) & FRAMES_MASK
        if count is None or came > _BACKWARDS:
            self._readers[reader] = _ReaderCount(sent_at, received)
            return
        frames = sent_at - count.sent_at
        if frames <= 0:
            return
        kept = exp(-frames / _MEMORY_FRAMES)
        count.sent = count.sent * kept + frames
        count.lost = count.lost * kept + frames - came
        count.sent_at, count.received = sent_at, received
        self._is_stale = True

    def forget(self, reader: bytes) -> None:
        """Forget a reader, or a former incarnation of it."""
        self._is_stale |= self._readers.pop(reader, None) is not None

    def loss(self, readers: Container[bytes], now_s: float) -> float | None:
        """Return the highest share of frames lost to one of ``readers``, 0 to 1; None: not known yet."""
        if self._is_stale and now_s >= self._next_s:
            self._is_stale, self._next_s = False, now_s + PACE_S
            self._readers = {name: count for name, count in self._readers.items() if name in readers}
            known = [count.loss for count in self._readers.values() if count.sent >= _LEAST_FRAMES]
            self._loss = max(known, default=None)
        return self._loss
