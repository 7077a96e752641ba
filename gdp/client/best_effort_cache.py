"""Best-effort cache: large messages of a best-effort topic that were sent lately, for repairs that are still in time.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``gdp/message/late_repairs.py`` is the reader's side.

A message of up to ``REPAIRS_ABOVE_PARTS`` fragments is not cached: it rarely loses one, and the next message replaces
it. The frames of others stay until the deadline of their topic, or until ``REPAIR_S`` after the last one was sent.
Repairs cause no more than half as many bytes as were sent for the first time, however many readers request them.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from typing import Final

from gdp.client.send_options import SendOptions
from gdp.frame.codec import NUMBER_AT, PARTS_MASK
from gdp.intervals import NEVER_S
from gdp.limits import REPAIR_S, REPAIRS_ABOVE_PARTS
from gdp.message.acknack import MissingRange
from gdp.message.history_cache import CachedMessage, HistoryCache
from gdp.message.retransmission import RetransmissionQueue, repair_allowance
from gdp.token_bucket import TokenBucket

CACHE_BYTES: Final = 8 << 20  # of frames of one topic; the oldest messages go first
_SHARE: Final = 0.5  # of the bytes sent for the first time: what repairs may add
FIRST_CREDIT_BYTES: Final = 256 << 10
_CREDIT_BYTES: Final = 1 << 20  # ... and may have saved up
_READERS_MAX: Final = 1_024  # whose allowances are remembered
# A fragment is sent again after one round trip, of which the queue of repairs waits 1.5. Readers repeat a request only
# after the time that repairs took before, so it is no duplicate; and a longer wait is most of the time that is left.
_ROUND_TRIPS: Final = 2 / 3
_PATIENCE: Final = 1.5  # round trips, within which a fragment behind the newest arrival may be under way
_NEWEST: Final = (1 << 64, 0)
_EVERYTHING: Final = 1 << 62  # the position before which all cached frames were sent
_NUMBER_PART_PARTS: Final = struct.Struct("!QII")


class BestEffortCache(HistoryCache):
    """Cache of the frames of one best-effort topic, with the repairs that its readers requested.

    Args:
        options: of the topic; without ``repairs`` nothing is cached.
    """

    def __init__(self, options: SendOptions) -> None:
        super().__init__()
        self._is_enabled = options.repairs
        self._deadline_s = options.deadline_s
        self._repairs = RetransmissionQueue()
        self.retransmissions = 0
        self._allowances: OrderedDict[bytes, TokenBucket] = OrderedDict()  # by reader
        self._credit_bytes = float(FIRST_CREDIT_BYTES)
        self._rtt_s: float | None = None

    def __len__(self) -> int:
        return len(self.messages)

    def set_options(self, options: SendOptions) -> None:
        """Change the options; without ``repairs`` what is cached is dropped."""
        self._is_enabled, self._deadline_s = options.repairs, options.deadline_s
        if not options.repairs:
            self.close()

    def record_sent(self, frames: Sequence[bytes], now_s: float) -> None:
        """Add frames that are sent for the first time now, in order; the cost depends on the count of messages."""
        at, end = 0, len(frames) if self._is_enabled else 0
        while at < end:
            number, part, parts = _NUMBER_PART_PARTS.unpack_from(frames[at], NUMBER_AT)
            parts &= PARTS_MASK
            count = min(parts - part, end - at)
            if parts > REPAIRS_ABOVE_PARTS:
                self._add(number, part, frames[at : at + count], now_s)
            at += count

    def request(
        self,
        reader: bytes,
        missing: Sequence[MissingRange],
        now_s: float,
        *,
        newest: tuple[int, int] = _NEWEST,
        rtt_s: float | None = None,
    ) -> None:
        """Queue what a reader reports as missing, as far as it is cached, in time, and within the bounds.

        Args:
            newest: number and fragment that came last; a later one is missing only after 1.5 round trips.
            rtt_s: smoothed round trip of the path; None: not measured.
        """
        self.drop_expired(now_s)
        if not self.messages:
            return
        arrived_s = now_s - _PATIENCE * (rtt_s or self._rtt_s or 0.0)
        missing = [
            each for each in (self._clip(each, newest, arrived_s) for each in missing) if each.first <= each.last
        ]
        if not missing:
            return
        self._sample_round_trip(missing, now_s)
        allowance = self._allowances.get(reader)
        if allowance is None:
            allowance = self._allowances[reader] = repair_allowance()
            if len(self._allowances) > _READERS_MAX:
                self._allowances.popitem(last=False)
        self._repairs.request(
            missing,
            allowance,
            self,
            sent_at=_EVERYTHING,
            rtt_s=None if self._rtt_s is None else max(_ROUND_TRIPS * self._rtt_s, _ROUND_TRIPS * (rtt_s or 0.0)),
            round_bytes=int(self._credit_bytes),
            now_s=now_s,
        )

    def frames_to_send(self, now_s: float, limit: int) -> list[bytes]:
        """Return at most ``limit`` repairs that are still in time."""
        if not self._repairs.queue:
            return []
        self.drop_expired(now_s)
        frames = self._repairs.frames_to_send(self, limit, now_s)
        self.retransmissions += len(frames)
        self._credit_bytes -= sum(map(len, frames))
        return frames

    def drop_expired(self, now_s: float) -> None:
        """Drop the messages whose time is over."""
        messages = self.messages
        while messages and messages[oldest := next(iter(messages))].until_s <= now_s:
            self.remove(oldest)

    def drop_larger(self, mtu: int) -> None:
        """Drop the messages whose frames no longer fit their path."""
        for number in [number for number, each in self.messages.items() if len(each.frames[0]) > mtu]:
            self.remove(number)

    def get_timer(self) -> float:
        """Return the monotonic second after which nothing needs to be cached; infinity: nothing is."""
        return self.messages[next(reversed(self.messages))].until_s if self.messages else NEVER_S

    def close(self) -> None:
        """Drop everything."""
        for number in list(self.messages):
            self.remove(number)
        self._repairs.clear()

    def _add(self, number: int, part: int, frames: Sequence[bytes], now_s: float) -> None:
        message = self.messages.get(number)
        if message is None:
            if part:
                return  # the cache was too small for its beginning
            self.drop_expired(now_s)
            message = self.messages[number] = CachedMessage(frames=[])
        if isinstance(message.frames, list):  # it was made here
            message.frames += frames
        message.batches.append((part + len(frames), now_s))
        if self._deadline_s is None or not part:
            message.until_s = now_s + (self._deadline_s or REPAIR_S)
        size = sum(map(len, frames))
        message.size += size
        self.held_bytes += size
        self._credit_bytes = min(self._credit_bytes + _SHARE * size, _CREDIT_BYTES)
        while self.held_bytes > CACHE_BYTES:
            self.remove(next(iter(self.messages)))

    def _clip(self, missing: MissingRange, newest: tuple[int, int], arrived_s: float) -> MissingRange:
        """Return a range without what may be under way: sent after the newest arrival, and after ``arrived_s``."""
        message = self.messages.get(missing.number)
        if message is None or (missing.number, missing.last) <= newest:
            return missing
        batches = bisect_right(message.batches, arrived_s, key=lambda batch: batch[1])
        sent_end = message.batches[batches - 1][0] if batches else 0
        if missing.number == newest[0]:
            sent_end = max(sent_end, newest[1])
        return missing._replace(last=min(missing.last, sent_end - 1))

    def _sample_round_trip(self, missing: Sequence[MissingRange], now_s: float) -> None:
        """Estimate the round-trip time: a reader finds a gap when it gets the fragment behind it.

        Shorter samples count at once. Longer ones count little, as the first report may have been lost.
        """
        number, _, last = missing[-1]
        message = self.messages.get(number)
        if message is None or message.again_s or last + 1 >= message.batches[-1][0]:
            return
        sample_s = now_s - message.batches[bisect_right(message.batches, last + 1, key=lambda batch: batch[0])][1]
        if self._rtt_s is None or sample_s < self._rtt_s:
            self._rtt_s = sample_s
        else:
            self._rtt_s += (sample_s - self._rtt_s) / 8
