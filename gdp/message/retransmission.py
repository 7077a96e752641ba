"""Retransmission of the fragments that readers report as missing.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A bound limits the work that a reader can cause at its writer. All readers together get a bounded size
of repairs in a round trip. Each reader has an allowance of fragments that are examined for its reports.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from gdp.intervals import Rate
from gdp.message.acknack import MissingRange
from gdp.message.flow_control import PROBES
from gdp.message.history_cache import HistoryCache
from gdp.token_bucket import TokenBucket

# fragments examined for reports of one reader: in a second more than a process sends, and 2 % of a core; at once more
# than a window of small frames has
_SCAN_RATE: Final = Rate(131_072, burst=8_192)
_NEVER: Final = float("-inf")


def repair_allowance() -> TokenBucket:
    """Return the fragments that may be examined for one reader."""
    return TokenBucket(*_SCAN_RATE)


class RetransmissionQueue:
    """Fragments to be sent again: ``queue``, by message number and fragment, in the order of the requests."""

    def __init__(self) -> None:
        self.queue: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._round_s = _NEVER  # when the present round began
        self._round_bytes = 0  # bytes that it may still send again

    def request(
        self,
        missing: Iterable[MissingRange],
        allowance: TokenBucket,
        cache: HistoryCache,
        *,
        sent_at: int,
        rtt_s: float | None,
        round_bytes: int,
        now_s: float,
    ) -> None:
        """Queue missing fragments that were sent, but not again within a round trip.

        A request beyond a reader's allowance is not examined; the reader repeats it.

        Args:
            sent_at: position before which everything has been sent.
            rtt_s: estimated round-trip time; None: unknown.
            round_bytes: most bytes that are sent again in a round trip.
        """
        wait_s = max(1.5 * (rtt_s or 0.0), PROBES.first_s / 3)
        if now_s - self._round_s >= wait_s:
            self._round_s, self._round_bytes = now_s, round_bytes
        allowed, examined = int(allowance.left(now_s)), 0
        for number, first, last in missing:
            message = cache.messages.get(number)
            if message is None or self._round_bytes <= 0:
                continue
            limit = first + allowed - examined
            for part in range(first, min(last + 1, len(message.frames), message.sent_parts(sent_at), limit)):
                examined += 1
                if self._round_bytes <= 0:
                    break
                key = (number, part)
                if key not in self.queue and message.again_s.get(part, _NEVER) <= now_s - wait_s:
                    self.queue[key] = None
                    self._round_bytes -= len(message.frames[part])
        allowance.charge(now_s, examined)

    def frames_to_send(
        self, cache: HistoryCache, limit: int, now_s: float, is_lacked: Callable[[int, int], bool] | None = None
    ) -> list[bytes]:
        """Remove and return at most ``limit`` frames from the queue, of those that some reader lacks still.

        Args:
            is_lacked: whether a reader may lack a fragment of a message that is cached; None: not known.
        """
        frames: list[bytes] = []
        while self.queue and len(frames) < limit:
            (number, part), _ = self.queue.popitem(last=False)
            if number in cache.messages and (is_lacked is None or is_lacked(number, part)):
                frames.append(cache.note_repair(number, part, now_s))
        return frames

    def clear(self) -> None:
        """Discard all requests."""
        self.queue.clear()
