"""What a reliable publisher keeps, how much of it may be under way, and what it sends again.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
Source: window growth and halving after RFC 5681, sections 3.1 and 3.2; round-trip estimate after RFC 6298, section 2,
with Karn's rule. Positions count bytes of frames from the first message on.

::

    released | kept, acknowledged by some | under way | waiting to go
             oldest                    acked        sent          end

A reader can make work for its publisher, but only so much: all readers together get at most a flight of repairs in a
round trip, and one that stands still, or that lags while others are through, no longer holds the window.

A suspended reader is silent, and may have moved. It holds neither the flight nor ``has_room``, but what it lacks stays
as long as the budget has room. When it reports again it gets repairs, and is a reader again once it has caught up.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from gdp.limits import (
    FLIGHT_MAX_BYTES,
    FLIGHT_MESSAGES_MAX,
    FLIGHT_MIN_BYTES,
    FLIGHT_START_BYTES,
    PROBE_MAX_S,
    PROBE_MIN_S,
    READER_LEASE_S,
    WINDOW_BYTES,
)
from gdp.message.move import Move
from gdp.message.report import Missing, Report

__all__ = ["SendWindow"]

_SCAN_PARTS: Final = 8_192  # parts looked at for reports of one reader at once; a flight of small frames has fewer
_SCAN_PARTS_PER_S: Final = 131_072  # ... and in a second: more than a process sends, and 2 % of a core
_GROWTH_BYTES: Final = 16 << 10  # of the flight in a round trip, above the threshold: these links are not narrow
_ROUND_MIN_S: Final = PROBE_MIN_S / 3


@dataclass(slots=True)
class _Kept:
    frames: Sequence[bytes]
    begin_at: int
    size: int
    repaired_s: dict[int, float] = field(default_factory=dict)  # part -> when it was last sent again

    @property
    def end_at(self) -> int:
        return self.begin_at + self.size

    def position(self, part: int) -> int:
        """Return where a part begins; all parts but the last have one length."""
        return self.begin_at + min(part * len(self.frames[0]), self.size)


@dataclass(slots=True)
class _Reader:
    acked_at: int
    next_number: int
    moved_s: float  # when it last confirmed something new, or had everything
    mark_at: int  # what another had confirmed at ``mark_s``; the mark moves on when this one has, too
    mark_s: float
    scans: float = _SCAN_PARTS  # parts that may still be looked at for its reports
    scans_s: float = 0.0  # when that was counted


class SendWindow:
    """The frames of a reliable topic, from the oldest that a reader may still lack to the newest.

    Args:
        keep_last: messages that are kept for late joiners, acknowledged or not.
        budget_bytes: how much is kept; when full, ``has_room`` is false, and past twice that ``add`` lets the oldest
            go.
        lag_s: how long a reader may hold the window while others are through.
    """

    def __init__(self, keep_last: int = 0, budget_bytes: int = WINDOW_BYTES, *, lag_s: float = READER_LEASE_S) -> None:
        self._lag_s = lag_s
        self._keep_last = keep_last
        self._budget_bytes = budget_bytes
        self._kept: OrderedDict[int, _Kept] = OrderedDict()
        self._readers: dict[bytes, _Reader] = {}
        self._suspended: dict[bytes, _Reader] = {}
        self._next = deque[tuple[int, int]]()  # (number, first part not sent), oldest first
        self._repairs: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._repaired = 0  # parts of kept messages that were sent again
        self._round_s = float("-inf")  # when the present round of repairs began
        self._round_bytes = 0  # what it may still bring
        self._newest = 0
        self._end_at = 0
        self._sent_at = 0
        self._kept_bytes = 0
        self._flight_bytes = FLIGHT_START_BYTES
        self._threshold_bytes = FLIGHT_MAX_BYTES
        self._rtt_s: float | None = None
        self._rtt_deviation_s = 0.0
        self._sample: tuple[int, float] | None = None  # (position, when it was sent)
        self._halved_s = float("-inf")
        self._quiet_s = 0.0  # since when nothing was acknowledged
        self._probe_s = PROBE_MIN_S
        self.repairs = 0
        self.let_go = 0  # messages dropped from a full window before every reader had them

    @property
    def oldest(self) -> int | None:
        """Return the lowest message number still kept, or None."""
        return next(iter(self._kept), None)

    @property
    def kept_bytes(self) -> int:
        """Return how many bytes of frames are kept."""
        return self._kept_bytes

    @property
    def flight_bytes(self) -> int:
        """Return how many bytes may be under way."""
        return self._flight_bytes

    @property
    def readers(self) -> int:
        """Return how many readers hold the window."""
        return len(self._readers)

    def has_reader(self, reader: bytes) -> bool:
        """Return whether a reader holds the window."""
        return reader in self._readers

    def is_suspended(self, reader: bytes) -> bool:
        """Return whether a reader is suspended."""
        return reader in self._suspended

    @property
    def suspended(self) -> int:
        """Return how many readers are suspended."""
        return len(self._suspended)

    def has_room(self) -> bool:
        """Return whether another message may be added without letting one go that a reader waits for."""
        is_idle = bool(self._suspended) and not self._readers
        return is_idle or self._end_at - self._acked_at() < self._budget_bytes

    def is_acknowledged(self) -> bool:
        """Return whether every reader has everything, suspended ones included."""
        has_all = all(reader.next_number > self._newest for reader in self._suspended.values())
        return has_all and self._acked_at() == self._end_at

    @property
    def sent(self) -> tuple[int, int]:
        """Return the message number and the part before which everything has been sent."""
        return self._next[0] if self._next else (self._newest + 1, 0)

    @property
    def acknowledged(self) -> int:
        """Return the highest message number that every reader, suspended or not, has confirmed, with all before it."""
        return min(self._least_number(), self._newest + 1) - 1

    def add(self, number: int, frames: Sequence[bytes], size: int) -> list[int]:
        """Queue a message of ``size`` bytes of frames, which may be sealed as they are asked for; numbers rise.

        Returns:
            the numbers of messages that were let go for it before every reader had them.
        """
        gone = []
        while self._kept and self._kept_bytes + size > self._budget_bytes:
            if self._kept_bytes + size <= self._budget_now():
                break
            oldest = next(iter(self._kept))
            if oldest >= self._least_number():
                gone.append(oldest)
            self._release(oldest)
        self.let_go += len(gone)
        self._newest = number
        self._kept[number] = _Kept(frames, self._end_at, size)
        self._kept_bytes += size
        self._end_at += size
        self._next.append((number, 0))
        return gone

    def kept(self) -> list[tuple[int, Sequence[bytes]]]:
        """Return what is kept, oldest first."""
        return [(number, kept.frames) for number, kept in self._kept.items()]

    def move(self, move: Move, frames: Sequence[tuple[int, Sequence[bytes], int]]) -> None:
        """Put what is kept anew, under new numbers, in place of the old; what all readers have does not go again.

        Args:
            frames: number, frames and their size; as in ``add``.
        """
        for number in list(self._kept):
            self._release(number)
        self._repairs.clear()
        self._sample = None
        for number, each, size in frames:
            self.add(number, each, size)
        everyone = [*self._readers.values(), *self._suspended.values()]
        for reader in everyone:
            reader.next_number = move.of(reader.next_number)
        least = self._least_waiting() if self._readers else 0
        while self._next and self._next[0][0] < least:
            self._sent_at = self._kept[self._next.popleft()[0]].end_at
        for reader in everyone:
            reader.acked_at = reader.mark_at = self._sent_at
        self._release_acknowledged()

    def add_reader(self, reader: bytes, first_number: int, now_s: float) -> None:
        """Let a reader hold the window from a message on."""
        self._suspended.pop(reader, None)
        kept = self._kept.get(first_number)
        acked_at = min(kept.begin_at, self._sent_at) if kept else self._sent_at
        self._readers[reader] = _Reader(acked_at, first_number, now_s, acked_at, now_s)

    def drop_reader(self, reader: bytes) -> None:
        """Let a reader hold nothing any more, and keep nothing for it."""
        if self._readers.pop(reader, None) or self._suspended.pop(reader, None):
            self._release_acknowledged()

    def suspend(self, reader: bytes) -> None:
        """Let a silent reader hold nothing, but keep what it lacks while there is room."""
        state = self._readers.pop(reader, None)
        if state is not None:
            self._suspended[reader] = state

    def resume(self, reader: bytes, now_s: float) -> None:
        """Let a suspended reader hold the window again, from where it is."""
        state = self._readers[reader] = self._suspended.pop(reader)
        state.moved_s = state.mark_s = now_s
        state.mark_at = state.acked_at

    def laggards(self, now_s: float) -> list[bytes]:
        """Return the readers that hold the window for nothing, whose time it is to let go.

        Such a one has confirmed nothing new of what was sent for ``READER_LEASE_S``; or not, for ``lag_s``, what
        another has.
        """
        first_at = self._first_at()
        return [
            name
            for name, reader in self._readers.items()
            if reader.acked_at < self._sent_at
            and (
                now_s - reader.moved_s > READER_LEASE_S
                or (now_s - reader.mark_s > self._lag_s and reader.acked_at < reader.mark_at <= first_at)
            )
        ]

    def next_laggard(self) -> float | None:
        """Return the monotonic second at which a reader that lags behind another is to let go, or None."""
        first_at = self._first_at()
        behind = (each.mark_s for each in self._readers.values() if each.acked_at < each.mark_at <= first_at)
        mark_s = min(behind, default=None)
        return None if mark_s is None else mark_s + self._lag_s + 0.001

    def report(self, reader: bytes, report: Report, now_s: float) -> None:
        """Take a known reader's report: release, grow or shrink, and queue repairs."""
        kept = self._kept.get(report.next_number)
        position = kept.position(report.next_part) if kept else self._position_of(report.next_number)
        if reader in self._suspended:
            if self._readers and position < self._acked_at():  # the others are not to wait for it
                self._suspended[reader].next_number = max(self._suspended[reader].next_number, report.next_number)
                self._queue_repairs(self._suspended[reader], report, now_s)
                self._release_acknowledged()
                return
            self._suspended[reader].acked_at = min(position, self._sent_at)
            self.resume(reader, now_s)
        state = self._readers[reader]
        state.next_number = max(state.next_number, report.next_number)
        before = self._acked_at()
        self._confirm(state, min(position, self._sent_at), now_s)
        self._grow(self._acked_at() - before, now_s)
        if self._queue_repairs(state, report, now_s) and now_s - self._halved_s > (self._rtt_s or PROBE_MIN_S):
            self._threshold_bytes = max(self._flight_bytes // 2, FLIGHT_MIN_BYTES)
            self._flight_bytes = self._threshold_bytes
            self._halved_s = now_s
        self._release_acknowledged()

    def take(self, now_s: float, limit: int = 1 << 30) -> list[bytes]:
        """Return the frames that may go now: repairs first, then new ones as far as the flight allows."""
        frames: list[bytes] = []
        while self._repairs and len(frames) < limit:
            (number, part), _ = self._repairs.popitem(last=False)
            if (kept := self._kept.get(number)) is not None:
                frames.append(kept.frames[part])
                self._repaired += part not in kept.repaired_s
                kept.repaired_s[part] = now_s
                self.repairs += 1
                self._sample = None  # Karn: nothing is learnt from what was sent twice
        acked_at = self._acked_at()
        if self._sent_at == acked_at:
            self._quiet_s = now_s
        may_reach = acked_at + self._flight_bytes
        below = 0
        if self._next:
            self._start_clocks(now_s)
            below = self._least_waiting() + FLIGHT_MESSAGES_MAX
        while self._next and self._sent_at < may_reach and len(frames) < limit and self._next[0][0] < below:
            number, part = self._next[0]
            kept = self._kept[number]
            size = len(kept.frames[0])
            count = min(max(1, (may_reach - self._sent_at) // size), limit - len(frames))
            batch = kept.frames[part : part + count]
            frames += batch
            self._sent_at += sum(map(len, batch))
            if part + len(batch) < len(kept.frames):
                self._next[0] = (number, part + len(batch))
            else:
                self._next.popleft()
        if frames and self._sample is None and not self._repaired:
            self._sample = (self._sent_at, now_s)
        if not self._readers and not self._next:
            self._release_acknowledged()
        return frames

    def probe_due(self, now_s: float) -> bool:
        """Return whether readers have been silent for too long while something is under way; backs off."""
        if not self._readers or now_s < self._quiet_s + self._probe_s or self._sent_at == self._acked_at():
            return False
        self._quiet_s = now_s
        self._probe_s = min(2 * self._probe_s, PROBE_MAX_S)
        return True

    def next_probe(self) -> float | None:
        """Return when ``probe_due`` may be true next, or None."""
        if not self._readers or self._sent_at == self._acked_at():
            return None
        return self._quiet_s + self._probe_s

    def _acked_at(self) -> int:
        return min((reader.acked_at for reader in self._readers.values()), default=self._sent_at)

    def _first_at(self) -> int:
        """Return how far the first reader is."""
        return max((reader.acked_at for reader in self._readers.values()), default=0)

    def _least_waiting(self) -> int:
        """Return the lowest number that a reader which holds the window lacks."""
        return min((reader.next_number for reader in self._readers.values()), default=1 << 64)

    def _least_number(self) -> int:
        """Return the lowest number that any reader lacks, suspended or not."""
        least = self._least_waiting()
        return min([least, *(each.next_number for each in self._suspended.values())]) if self._suspended else least

    def _budget_now(self) -> int:
        """Return how many bytes may be kept: less where what is oldest is kept for suspended readers alone."""
        oldest = self.oldest
        is_spare = len(self._kept) > self._keep_last and oldest is not None and oldest < self._least_waiting()
        return self._budget_bytes if self._suspended and is_spare else 2 * self._budget_bytes

    def _position_of(self, number: int) -> int:
        """Return where a message that is not kept begins or would begin."""
        oldest = self.oldest
        return self._kept[oldest].begin_at if oldest is not None and number < oldest else self._end_at

    def _confirm(self, reader: _Reader, position: int, now_s: float) -> None:
        if position > reader.acked_at:
            reader.acked_at = position
            reader.moved_s = now_s
        first_at = self._first_at()
        for each in self._readers.values():
            if each.mark_at <= each.acked_at < first_at:
                each.mark_at, each.mark_s = first_at, now_s

    def _start_clocks(self, now_s: float) -> None:
        """Begin to wait only now for readers that owed nothing."""
        for reader in self._readers.values():
            if reader.acked_at >= self._sent_at:
                reader.moved_s = now_s

    def _grow(self, acknowledged_bytes: int, now_s: float) -> None:
        if acknowledged_bytes <= 0:
            return
        self._quiet_s = now_s
        if self._flight_bytes < self._threshold_bytes:
            self._flight_bytes += acknowledged_bytes
        else:
            self._flight_bytes += acknowledged_bytes * _GROWTH_BYTES // self._flight_bytes
        self._flight_bytes = min(self._flight_bytes, FLIGHT_MAX_BYTES)
        if self._sample is not None and self._acked_at() >= self._sample[0]:
            self._learn_rtt(now_s - self._sample[1])
            self._sample = None
        self._probe_s = min(max(3 * (self._rtt_s or 0.0) + 4 * self._rtt_deviation_s, PROBE_MIN_S), PROBE_MAX_S)

    def _learn_rtt(self, sample_s: float) -> None:
        if self._rtt_s is None:
            self._rtt_s, self._rtt_deviation_s = sample_s, sample_s / 2
            return
        self._rtt_deviation_s += (abs(sample_s - self._rtt_s) - self._rtt_deviation_s) / 4
        self._rtt_s += (sample_s - self._rtt_s) / 8

    def _queue_repairs(self, reader: _Reader, report: Report, now_s: float) -> bool:
        """Queue what is missing and was sent, but not sent again within a round trip; return whether any was.

        What a reader asks for beyond its share of work is not looked at; it asks again.
        """
        wait_s = max(1.5 * (self._rtt_s or 0.0), _ROUND_MIN_S)
        if now_s - self._round_s >= wait_s:
            self._round_s, self._round_bytes = now_s, self._flight_bytes
        reader.scans = min(reader.scans + max(now_s - reader.scans_s, 0.0) * _SCAN_PARTS_PER_S, _SCAN_PARTS)
        reader.scans_s = now_s
        queued = False
        for missing in report.missing:
            kept = self._kept.get(missing.number)
            if kept is None:
                continue
            for part in self._sent_parts(kept, missing, int(reader.scans)):
                reader.scans -= 1
                if self._round_bytes <= 0:
                    return queued
                key = (missing.number, part)
                if key in self._repairs or kept.repaired_s.get(part, float("-inf")) > now_s - wait_s:
                    continue
                self._repairs[key] = None
                self._round_bytes -= len(kept.frames[part])
                queued = True
        return queued

    def _sent_parts(self, kept: _Kept, missing: Missing, limit: int) -> range:
        """Return those of the parts that exist and have been sent, at most ``limit``."""
        sent = -(-(self._sent_at - kept.begin_at) // len(kept.frames[0]))
        end = min(missing.last + 1, len(kept.frames), max(sent, 0), missing.first + limit)
        return range(missing.first, end)

    def _release_acknowledged(self) -> None:
        least = self._least_number()
        spare = len(self._kept) - self._keep_last
        for number in list(islice(self._kept, max(spare, 0))):
            if number >= least or (self._readers and self._kept[number].end_at > self._sent_at):
                break
            self._release(number)

    def _release(self, number: int) -> None:
        kept = self._kept.pop(number)
        self._kept_bytes -= kept.size
        self._repaired -= len(kept.repaired_s)
        self._sent_at = max(self._sent_at, kept.end_at)
        while self._next and self._next[0][0] <= number:
            self._next.popleft()
