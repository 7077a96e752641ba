"""Acknowledgement state of the readers of a reliable writer.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Positions count bytes of frames from the first message on.

An active reader blocks the send window until it acknowledges; a suspended one does not. A reader is slow when it
acknowledges nothing for ``READER.lease_s``, or lags behind another one for longer than the tolerated lag.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from gdp.intervals import NEVER_S, READER
from gdp.message.retransmission import repair_allowance
from gdp.token_bucket import TokenBucket

_BEYOND_ALL: Final = 1 << 64  # above every message number and position


@dataclass(slots=True, kw_only=True)
class ReaderPosition:
    """How much one reader has acknowledged.

    Attributes:
        acked_at: position before which it has everything.
        next_number: message before which it has everything.
        last_progress_s: when it last acknowledged something new, or had everything.
        mark_at: what another reader had acknowledged at ``mark_s``; the mark advances when this reader has reached it.
        allowance: repairs that may be examined for it.
    """

    acked_at: int
    next_number: int
    last_progress_s: float
    mark_at: int
    mark_s: float
    allowance: TokenBucket = field(default_factory=repair_allowance)


class ReaderPositions:
    """The positions of all readers.

    Args:
        lag_s: how long a reader may lag behind another before it counts as slow.

    Attributes:
        active: readers that block the window, by name.
        suspended: readers that do not, by name.
        least_at: position that every active reader has acknowledged; above all positions without one.
        most_at: position of the most advanced active reader; 0 without one.
        least_number: lowest message number that an active reader lacks; above all numbers without one.
        most_number: highest message number before which an active reader lacks nothing; above all without one.
    """

    def __init__(self, lag_s: float) -> None:
        self._lag_s = lag_s
        self.active: dict[bytes, ReaderPosition] = {}
        self.suspended: dict[bytes, ReaderPosition] = {}
        self.refresh()

    def refresh(self) -> None:
        """Compute the extremes of the active readers; it follows each change of a position."""
        least_at, most_at, least, most = _BEYOND_ALL, 0, _BEYOND_ALL, -1
        for each in self.active.values():
            at, number = each.acked_at, each.next_number
            least_at, most_at = at if at < least_at else least_at, at if at > most_at else most_at
            least, most = number if number < least else least, number if number > most else most
        self.least_at, self.most_at, self.least_number = least_at, most_at, least
        self.most_number = most if self.active else _BEYOND_ALL

    def add(self, reader: bytes, acked_at: int, next_number: int, now_s: float) -> None:
        """Add an active reader, or restart one."""
        self.suspended.pop(reader, None)
        self.active[reader] = ReaderPosition(
            acked_at=acked_at, next_number=next_number, last_progress_s=now_s, mark_at=acked_at, mark_s=now_s
        )
        self.refresh()

    def remove(self, reader: bytes) -> bool:
        """Remove a reader; return whether there was one."""
        position = self.active.pop(reader, None) or self.suspended.pop(reader, None)
        self.refresh()
        return position is not None

    def suspend(self, reader: bytes) -> None:
        """Suspend an active reader; others are left as they are."""
        position = self.active.pop(reader, None)
        if position is not None:
            self.suspended[reader] = position
            self.refresh()

    def resume(self, reader: bytes, now_s: float) -> None:
        """Reactivate a suspended reader at its position. Raises ``KeyError``: it is not suspended."""
        position = self.active[reader] = self.suspended.pop(reader)
        position.last_progress_s = position.mark_s = now_s
        position.mark_at = position.acked_at
        self.refresh()

    def all(self) -> list[ReaderPosition]:
        """Return every position, active ones first."""
        return [*self.active.values(), *self.suspended.values()]

    def is_ahead(self, reader: bytes, number: int) -> bool:
        """Return whether a reader is active, and lacks no message up to a number: it began later, or has them."""
        position = self.active.get(reader)
        return position is not None and position.next_number > number

    def least(self) -> int:
        """Return the lowest message number that any reader lacks, suspended or not."""
        least = self.least_number
        return min([least, *(each.next_number for each in self.suspended.values())]) if self.suspended else least

    def acknowledge(self, position: ReaderPosition, acked_at: int, now_s: float) -> None:
        """Advance an active reader, and the marks that other readers are measured against."""
        if acked_at > position.acked_at:
            position.acked_at = acked_at
            position.last_progress_s = now_s
        self.refresh()
        for each in self.active.values() if self.least_at != self.most_at else ():
            if each.mark_at <= each.acked_at < self.most_at:
                each.mark_at, each.mark_s = self.most_at, now_s

    def reset_stall_timers(self, sent_at: int, now_s: float) -> None:
        """Restart the timers of readers that have everything sent before ``sent_at``: they owe nothing."""
        for each in self.active.values():
            if each.acked_at >= sent_at:
                each.last_progress_s = now_s

    def slow(self, sent_at: int, now_s: float) -> list[bytes]:
        """Return the active readers that have stalled, or lag behind another for longer than tolerated."""
        return [
            name
            for name, each in self.active.items()
            if each.acked_at < sent_at
            and (
                now_s - each.last_progress_s > READER.lease_s
                or (now_s - each.mark_s > self._lag_s and each.acked_at < each.mark_at <= self.most_at)
            )
        ]

    def next_slow(self) -> float:
        """Return the monotonic second at which a reader that lags behind another becomes slow; infinity: never."""
        if self.least_at == self.most_at:
            return NEVER_S
        behind = [each.mark_s for each in self.active.values() if each.acked_at < each.mark_at <= self.most_at]
        return min(behind, default=NEVER_S) + self._lag_s + 0.001
