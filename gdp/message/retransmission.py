"""Retransmission of the fragments that readers report as missing.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A bound limits the work that a reader can cause at its writer. All readers together get a bounded size
of repairs in a round trip. Each reader has an allowance of fragments that are examined for its reports.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from gdp.limits import PROBE_MIN_S
from gdp.message.acknack import MissingRange
from gdp.message.history_cache import CachedMessage

__all__ = ["RepairAllowance", "RetransmissionQueue"]

_SCAN_PARTS: Final = 8_192  # fragments examined for reports of one reader at once; a window of small frames has fewer
_SCAN_PARTS_PER_S: Final = 131_072  # ... and in a second: more than a process sends, and 2 % of a core
_ROUND_MIN_S: Final = PROBE_MIN_S / 3
_NEVER: Final = float("-inf")


@dataclass(slots=True)
class RepairAllowance:
    """Token bucket of the fragments that may still be examined for one reader."""

    parts: float = _SCAN_PARTS
    refilled_s: float = 0.0

    def refill(self, now_s: float) -> None:
        """Add what has accrued since the last call."""
        self.parts = min(self.parts + max(now_s - self.refilled_s, 0.0) * _SCAN_PARTS_PER_S, _SCAN_PARTS)
        self.refilled_s = now_s


class RetransmissionQueue:
    """Fragments to be sent again, in the order of the requests.

    Attributes:
        retransmissions: fragments sent again so far.
    """

    def __init__(self) -> None:
        self.retransmissions = 0
        self._queue: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._sent_s: dict[int, dict[int, float]] = {}  # message -> fragment -> when it was last sent again
        self._round_s = _NEVER  # when the present round began
        self._round_bytes = 0  # bytes that it may still send again

    def __bool__(self) -> bool:
        return bool(self._queue)

    @property
    def has_repaired(self) -> bool:
        """Return whether a fragment of a message that is still cached was sent again."""
        return bool(self._sent_s)

    def request(
        self,
        missing: Iterable[MissingRange],
        allowance: RepairAllowance,
        messages: Mapping[int, CachedMessage],
        *,
        sent_at: int,
        rtt_s: float | None,
        round_bytes: int,
        now_s: float,
    ) -> bool:
        """Queue missing fragments that were sent, but not again within a round trip; return whether any was.
        A request beyond a reader's allowance is not examined; the reader repeats it.

        Args:
            sent_at: position before which everything has been sent.
            rtt_s: estimated round-trip time; None: unknown.
            round_bytes: most bytes that are sent again in a round trip.
        """
        wait_s = max(1.5 * (rtt_s or 0.0), _ROUND_MIN_S)
        if now_s - self._round_s >= wait_s:
            self._round_s, self._round_bytes = now_s, round_bytes
        allowance.refill(now_s)
        queued = False
        for number, first, last in missing:
            message = messages.get(number)
            if message is None:
                continue
            sent_s = self._sent_s.get(number, {})
            limit = first + int(allowance.parts)
            for part in range(first, min(last + 1, len(message.frames), message.sent_parts(sent_at), limit)):
                allowance.parts -= 1
                if self._round_bytes <= 0:
                    return queued
                key = (number, part)
                if key in self._queue or sent_s.get(part, _NEVER) > now_s - wait_s:
                    continue
                self._queue[key] = None
                self._round_bytes -= len(message.frames[part])
                queued = True
        return queued

    def frames_to_send(
        self,
        messages: Mapping[int, CachedMessage],
        limit: int,
        now_s: float,
        is_lacked: Callable[[int, int], bool] | None = None,
    ) -> list[bytes]:
        """Remove and return at most ``limit`` frames from the queue, of those that some reader lacks still.

        Args:
            is_lacked: whether a reader may lack a fragment of a message that is cached; None: not known.
        """
        frames: list[bytes] = []
        while self._queue and len(frames) < limit:
            (number, part), _ = self._queue.popitem(last=False)
            message = messages.get(number)
            if message is not None and (is_lacked is None or is_lacked(number, part)):
                frames.append(message.frames[part])
                self._sent_s.setdefault(number, {})[part] = now_s
                self.retransmissions += 1
        return frames

    def forget(self, number: int) -> None:
        """Discard the history of a message that is no longer cached."""
        if self._sent_s:
            self._sent_s.pop(number, None)

    def clear(self) -> None:
        """Discard all requests."""
        self._queue.clear()
