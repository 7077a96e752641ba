"""Send scheduler of a participant: the order in which its publishers send; urgent first, then round robin.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: Linux ``sch_prio``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gdp.client.publisher import Publisher

__all__ = ["BYTES_AT_ONCE", "BYTES_WITH_URGENT", "SendScheduler"]

BYTES_AT_ONCE: Final = 96 << 10  # of ordinary frames, before any other publisher has its turn
BYTES_WITH_URGENT: Final = 64 << 10  # ... with an urgent topic, whose frames may have to wait for this amount


class SendScheduler:
    """Publishers with frames to send; urgent ones first, the others in turn.

    Args:
        asked: called with each publisher whose frames were polled.
    """

    def __init__(self, asked: Callable[[Publisher], None]) -> None:
        self._asked = asked
        self._urgent: dict[Publisher, None] = {}
        self._ordinary: dict[Publisher, None] = {}  # the one whose turn it is comes first
        self._at_once = BYTES_AT_ONCE

    def __bool__(self) -> bool:
        return bool(self._urgent or self._ordinary)

    def add(self, publisher: Publisher) -> None:
        """Note that a publisher may have frames; one that already waits for its turn keeps its position."""
        if publisher.is_urgent:
            self._at_once = BYTES_WITH_URGENT
            self._urgent[publisher] = None
        else:
            self._ordinary[publisher] = None

    def poll_turn(self, now_s: float) -> list[list[bytes]]:
        """Return the frames that leave now, urgent and ordinary ones apart; an empty publisher leaves the queue."""
        urgent = [frame for publisher in list(self._urgent) for frame in self._ask(publisher, self._urgent, now_s)]
        urgent_bytes = sum(map(len, urgent))
        if 0 < urgent_bytes < self._at_once // 2:
            return [urgent]  # it leaves now; the others' next chunk is sealed after that
        ordinary: list[bytes] = []
        left = self._at_once
        for publisher in list(self._ordinary):
            frames = self._ask(publisher, self._ordinary, now_s, left)
            ordinary += frames
            left -= sum(map(len, frames))
            if left < self._at_once // 2:
                break
        return [frames for frames in (urgent, ordinary) if frames]

    def _ask(
        self, publisher: Publisher, waiting: dict[Publisher, None], now_s: float, at_most_bytes: int | None = None
    ) -> list[bytes]:
        del waiting[publisher]
        frames = publisher.poll_frames(now_s, at_most_bytes or self._at_once)
        if publisher.has_more:
            waiting[publisher] = None  # behind the others
        self._asked(publisher)
        return frames
