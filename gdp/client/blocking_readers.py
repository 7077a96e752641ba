"""Readers that block the others of a reliable topic, because their path is far slower.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A publisher goes as slowly as its slowest reader. One that
holds back the others for the tolerated lag, and got less than ``PROGRESS_BYTES`` meanwhile, no longer counts. It gets
what is sent as before, and skips what is gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

__all__ = ["PROGRESS_BYTES", "BlockingReaders"]

PROGRESS_BYTES: Final = 256 << 10
_BLOCKED_SHARE: Final = 0.5  # of the lag in which a reader was the only obstacle


@dataclass(slots=True)
class _Block:
    since_s: float
    sent_bytes: int  # of the publisher, at that time
    checked_s: float
    blocked_s: float = 0.0


class BlockingReaders:
    """Blocks of one publisher's readers.

    Args:
        lag_s: how long a reader may hold back the others.
    """

    def __init__(self, lag_s: float) -> None:
        self._lag_s = lag_s
        self._blocks: dict[bytes, _Block] = {}

    def record(self, allowances: Sequence[tuple[bytes, int]], sent_bytes: int, now_s: float) -> None:
        """Note what the paths to the readers permit now, in bytes."""
        free = sum(allowance > 0 for _, allowance in allowances)
        for name, allowance in allowances:
            is_blocking = allowance <= 0 and free == len(allowances) - 1
            block = self._blocks.get(name)
            if block is None:
                if is_blocking:
                    self._blocks[name] = _Block(now_s, sent_bytes, now_s)
                continue
            if is_blocking:
                block.blocked_s += now_s - block.checked_s
            block.checked_s = now_s

    def slow(self, sent_bytes: int, now_s: float) -> list[bytes]:
        """Return the readers that must no longer block the others; all are measured again after the lag."""
        slow = []
        for name, block in list(self._blocks.items()):
            if now_s - block.since_s < self._lag_s:
                continue
            del self._blocks[name]
            is_obstacle = block.blocked_s >= _BLOCKED_SHARE * (now_s - block.since_s)
            if is_obstacle and sent_bytes - block.sent_bytes < PROGRESS_BYTES:
                slow.append(name)
        return slow

    def get_timer(self) -> float | None:
        """Return the monotonic second at which a reader may be too slow, or None."""
        return min((block.since_s + self._lag_s for block in self._blocks.values()), default=None)
