"""Readers that block the others of a topic, because their path is far slower.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A publisher goes as slowly as its slowest reader. One that
holds back the others for the tolerated lag, and whose path carried less than ``PROGRESS_BYTES`` meanwhile, no longer
counts. It gets what is sent as before, and skips what is gone. A path that other topics fill is no such one, however
little this topic sends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.intervals import NEVER_S

PROGRESS_BYTES: Final = 256 << 10
_BLOCKED_SHARE: Final = 0.5  # of the lag in which a reader was the only obstacle


class PathState(NamedTuple):
    """Path to one reader node: bytes that may leave now, and bytes of all topics that have left so far."""

    reader: bytes
    allowance: int
    sent_bytes: int


@dataclass(slots=True)
class _Block:
    since_s: float
    first_bytes: int  # sent on the path at that time
    checked_s: float
    sent_bytes: int
    is_blocking: bool = True
    blocked_s: float = 0.0


class BlockingReaders:
    """Blocks of one publisher's readers.

    Args:
        lag_s: how long a reader may hold back the others.
        most: how many may do so at once, without being an obstacle each.
        progress_bytes: a path that carried as much meanwhile is no obstacle.

    Attributes:
        blocks: of the readers that are measured.
    """

    def __init__(self, lag_s: float, *, most: int = 1, progress_bytes: float = PROGRESS_BYTES) -> None:
        self._lag_s, self._most, self._progress_bytes = lag_s, most, progress_bytes
        self.blocks: dict[bytes, _Block] = {}

    def record(self, paths: Sequence[PathState], now_s: float) -> None:
        """Note the paths that govern, while something waits for them or begins to leave."""
        free = sum(each.allowance > 0 for each in paths)
        is_one_obstacle = free > 0 and len(paths) - free <= self._most
        blocking = {each.reader for each in paths if each.allowance <= 0 and is_one_obstacle}
        sent_bytes = {each.reader: each.sent_bytes for each in paths}
        for name, block in self.blocks.items():
            if block.is_blocking:
                block.blocked_s += now_s - block.checked_s
            block.checked_s, block.is_blocking = now_s, name in blocking
            block.sent_bytes = sent_bytes.get(name, block.sent_bytes)
        for name in blocking - self.blocks.keys():
            self.blocks[name] = _Block(now_s, sent_bytes[name], now_s, sent_bytes[name])

    def slow(self, now_s: float) -> list[bytes]:
        """Return the readers that must no longer block the others; all are measured again after the lag."""
        slow = []
        for name, block in list(self.blocks.items()):
            if now_s - block.since_s < self._lag_s:
                continue
            del self.blocks[name]
            blocked_s = block.blocked_s + (now_s - block.checked_s if block.is_blocking else 0.0)
            is_obstacle = blocked_s >= _BLOCKED_SHARE * (now_s - block.since_s)
            if is_obstacle and block.sent_bytes - block.first_bytes < self._progress_bytes:
                slow.append(name)
        return slow

    def get_timer(self) -> float:
        """Return the monotonic second at which a reader may be too slow; infinity: none is measured."""
        return min((block.since_s for block in self.blocks.values()), default=NEVER_S) + self._lag_s
