"""Deferred messages of a writer: kept before its first reader, unsealed, oldest first."""

from __future__ import annotations

from collections import deque

from gdp.client.send_options import SendOptions
from gdp.limits import WINDOW_BYTES
from gdp.message.ledger import Ledger
from gdp.message.loss import LossReason


class DeferredMessages:
    """Messages that wait for the first reader; those beyond the history are lost.

    Args:
        ledger: of the writer.

    Attributes:
        waiting: sequence number, message, and since when it waits, oldest first.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.waiting = deque[tuple[int, bytes, float | None]]()
        self._held_bytes = 0

    def add(self, message: bytes, added_s: float | None) -> None:
        """Add a message; ``added_s``: when it is published; None: it does not age."""
        self.waiting.append((self._ledger.next(added_s), message, added_s))
        self._held_bytes += len(message)

    def pop(self) -> tuple[int, bytes, float | None]:
        """Remove and return the oldest: sequence number, message, and when it was published."""
        oldest = self.waiting.popleft()
        self._held_bytes -= len(oldest[1])
        return oldest

    def count_before(self, since_s: float) -> int:
        """Return how many were published before a second; those of an unknown time were."""
        return sum(added_s is None or added_s < since_s for *_, added_s in self.waiting)

    def drop_beyond(self, keep: int, options: SendOptions, now_s: float | None, *, is_latched: bool) -> int:
        """Drop the oldest messages above ``keep``, and beyond the history; return how many."""
        dropped = 0
        while self.waiting and (len(self.waiting) > keep or self._is_beyond(options, now_s, is_latched=is_latched)):
            sequence, _, _ = self.pop()
            self._ledger.lose(sequence, sequence, LossReason.NO_READER)
            dropped += 1
        return dropped

    def _is_beyond(self, options: SendOptions, now_s: float | None, *, is_latched: bool) -> bool:
        """Return whether the oldest is one too many by bytes, or too old."""
        added_s = self.waiting[0][2]
        if not is_latched and self._held_bytes > WINDOW_BYTES and len(self.waiting) > 1:
            return True
        if options.history_bytes is not None and self._held_bytes > options.history_bytes:
            return True
        if options.history_age_s is None or added_s is None or now_s is None:
            return False
        return now_s - added_s >= options.history_age_s
