"""Send window of a reliable writer.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Positions count bytes of frames from the first message on.

::

    released | cached, acknowledged by some | under way | waiting to be sent
             oldest                       acked        sent                end

The window joins four parts: ``history_cache.py`` (what can be sent again), ``flow_control.py`` (how much may be under
way), ``retransmission.py`` (what is sent again) and ``acknowledgement.py`` (what readers have).

A suspended reader is silent, and may have moved. It blocks neither the congestion window nor ``has_space``. What it
lacks stays cached as long as the budget allows. When it reports again it gets repairs, and becomes active once it has
caught up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from gdp.intervals import NEVER_S, READER
from gdp.limits import FLIGHT_MESSAGES_MAX, REPAIRS_MAX_BYTES, WINDOW_BYTES
from gdp.message.acknack import AckNack
from gdp.message.acknowledgement import ReaderPositions
from gdp.message.flow_control import FlowControl
from gdp.message.history_cache import CachedMessage, HistoryCache
from gdp.message.renumbering import Renumbering
from gdp.message.retransmission import RetransmissionQueue


class SendWindow:
    """The frames of a reliable topic, from the oldest that a reader may still lack to the newest.

    Args:
        history_depth: messages that stay for late joiners, acknowledged or not.
        first_number: lowest message number that ``add`` will get.
        budget_bytes: size of the cache. When it is full, ``has_space`` is false; beyond twice that ``add`` evicts the
            oldest.
        lag_s: how long a reader may block the window while others have acknowledged.

    Attributes:
        readers: what each has acknowledged, and which block nothing.
        governing: the reader that alone governs what leaves; None: all do, and the slowest decides.
        cache: what can be sent again.
        unsent: numbers of messages with a fragment that was never sent, and the first such one, oldest first.
        retransmissions: fragments that were sent again.
    """

    def __init__(
        self,
        *,
        history_depth: int = 0,
        first_number: int = 1,
        budget_bytes: int = WINDOW_BYTES,
        lag_s: float = READER.lease_s,
    ) -> None:
        self._budget_bytes = budget_bytes
        self.cache = HistoryCache(history_depth)
        self._flow = FlowControl()
        self.readers = ReaderPositions(lag_s)
        self._repairs = RetransmissionQueue()
        self._late_repairs = RetransmissionQueue()  # of readers that do not govern: they leave after what is new
        self._cancelled: set[int] = set()  # messages that were sent, and are not repaired
        self.unsent = deque[tuple[int, int]]()
        self._newest = first_number - 1
        self._sent_at = 0
        self._now_s = 0.0  # of the latest event
        self._sent_before = 0  # messages before this one were sent, if under an old number
        self.governing: bytes | None = None
        self.retransmissions = 0

    def has_space(self) -> bool:
        """Return whether ``add`` would evict no message that a reader waits for."""
        is_idle = bool(self.readers.suspended) and not self.readers.active
        return is_idle or self.cache.end_at - self._acked_at() < self._budget_bytes

    def is_acknowledged(self) -> bool:
        """Return whether every reader has everything, suspended ones included."""
        has_all = all(each.next_number > self._newest for each in self.readers.suspended.values())
        return has_all and self._acked_at() == self.cache.end_at

    @property
    def sent(self) -> tuple[int, int]:
        """Return the message number and the fragment before which everything has been sent."""
        return self.unsent[0] if self.unsent else (self._newest + 1, 0)

    def set_history_depth(self, depth: int, next_number: int) -> None:
        """Change how many messages stay for late joiners; ``next_number`` is the lowest that ``add`` will get."""
        self.cache.depth = depth
        self._newest = max(self._newest, next_number - 1)
        self._release_acknowledged()

    def set_history_bounds(self, depth_bytes: int | None, age_s: float | None) -> None:
        """Change how many bytes stay for late joiners, and for how many seconds; None: the depth alone counts."""
        self.cache.depth_bytes, self.cache.age_s = depth_bytes, age_s
        self._release_acknowledged()

    def release_aged(self, now_s: float) -> None:
        """Release what is too old for late joiners."""
        self._now_s = now_s
        if self.cache.age_s is not None:
            self._release_acknowledged()

    def add(self, number: int, frames: Sequence[bytes], size: int, added_s: float | None = None) -> list[int]:
        """Queue a message of ``size`` bytes of frames, which may be sealed when they are read; numbers rise.

        Args:
            added_s: from when it ages; None: from the latest event.

        Returns:
            the numbers of messages that were evicted for it before every reader had them.
        """
        evicted = []
        while self.cache.held_bytes + size > self._budget_bytes and self.cache.messages:
            if self.cache.held_bytes + size <= self._budget_now():
                break
            oldest = next(iter(self.cache.messages))
            if oldest >= self.readers.least():
                evicted.append(oldest)
            self._release([oldest])
        self._newest = number
        self.cache.add(number, frames, size, self._now_s if added_s is None else added_s)
        self.unsent.append((number, 0))
        return evicted

    def cancel(self, number: int) -> bool:
        """Send nothing more of a message, and repair nothing; return whether some reader lacks it for good.

        One that was sent whole is on its way: readers lack it only if they request something of it.
        """
        message, waiting = self.cache.messages.get(number), self.unsent
        if message is None:
            return False
        if number < self.sent[0]:
            self._cancelled.add(number)
            return False
        unsent = next(index for index, (each, _) in enumerate(waiting) if each == number)
        if not unsent:
            self._sent_at = message.end_at
        del waiting[unsent]
        self._forget(number)
        return True

    def poll_cancelled(self, acknack: AckNack) -> list[int]:
        """Remove and return the cancelled messages of which a reader requests something."""
        lacked = self._cancelled & {each.number for each in acknack.missing} if self._cancelled else set()
        for number in lacked:
            self._forget(number)
        return sorted(lacked)

    def renumber(self, move: Renumbering, frames: Sequence[tuple[int, Sequence[bytes], int]]) -> None:
        """Replace all that is cached, under new numbers; what all readers have is not sent again.

        Args:
            frames: number, frames and their size; as in ``add``.
        """
        self._sent_before = move.new_number(max(self._sent_before, self.sent[0]))
        ages_s = {move.new_number(number): each.added_s for number, each in self.cache.messages.items()}
        if self.cache.messages:
            self._release(list(self.cache.messages))
        self._repairs.clear()
        self._late_repairs.clear()
        self._cancelled = {move.new_number(number) for number in self._cancelled}
        self._flow.round_trip.discard_sample()
        for number, each, size in frames:
            self.add(number, each, size, ages_s.get(number))
        positions = self.readers.all()
        for position in positions:
            position.next_number = move.new_number(position.next_number)
        self.readers.refresh()
        self._skip_unwanted()
        for position in positions:
            position.acked_at = position.mark_at = self._sent_at
        self.readers.refresh()
        self._release_acknowledged()

    def add_reader(self, reader: bytes, first_number: int, now_s: float) -> None:
        """Make a reader active from a message on."""
        message = self.cache.messages.get(first_number)
        acked_at = min(message.begin_at, self._sent_at) if message else self._sent_at
        self.readers.add(reader, acked_at, first_number, now_s)

    def drop_reader(self, reader: bytes) -> None:
        """Remove a reader, and release what was cached for it alone."""
        if self.readers.remove(reader):
            self._release_acknowledged()

    def slow_readers(self, now_s: float) -> list[bytes]:
        """Return the active readers that must no longer block the window."""
        return self.readers.slow(self._sent_at, now_s)

    def handle_acknack(self, reader: bytes, acknack: AckNack, now_s: float, trip_s: float = 0.0) -> None:
        """Process the report of a known reader: release what all have, and queue repairs.

        Args:
            trip_s: round trip of its path; 0: not known. Repairs give none here, so it may be known there alone.
        """
        self._now_s = now_s
        message = self.cache.messages.get(acknack.next_number)
        if message is not None:
            position = message.position(acknack.next_part) if acknack.next_part else message.begin_at
        elif acknack.next_number > self._newest:
            position = self.cache.end_at
        else:
            position = self.cache.begin_of(acknack.next_number)
        sent = max(self._sent_before, self.unsent[0][0] if self.unsent else self._newest + 1)
        next_number = acknack.next_number if acknack.next_number < sent else sent  # no reader has more
        suspended = self.readers.suspended.get(reader)
        if suspended is not None:
            # the others must not wait for it
            if self.readers.active and position < self.readers.least_at:
                suspended.next_number = max(suspended.next_number, next_number)
                self._request_repairs(reader, acknack, now_s, trip_s)
                self._release_acknowledged()
                return
            suspended.acked_at = min(position, self._sent_at)
            self.readers.resume(reader, now_s)
        state = self.readers.active[reader]
        state.next_number = next_number if next_number > state.next_number else state.next_number
        if self.unsent:
            self.readers.refresh()
            self._skip_unwanted()
        before = self.readers.least_at
        self.readers.acknowledge(state, min(position, self._sent_at), now_s)
        self._flow.handle_acknowledged(self.readers.least_at - before, self.readers.least_at, now_s)
        if acknack.missing:
            self._request_repairs(reader, acknack, now_s, trip_s)
        self._release_acknowledged()

    @property
    def has_frames(self) -> bool:
        """Return whether something waits to be sent, or sent again; or no reader waits for it."""
        return bool(self.unsent or self._repairs.queue) or not self.readers.active

    def frames_to_send(self, now_s: float, limit: int = 1 << 30) -> list[bytes]:
        """Return at most ``limit`` frames: repairs first, then new ones as far as the readers can hold them."""
        self._now_s = now_s
        frames: list[bytes] = []
        if self._repairs.queue and (frames := self._repaired_frames(limit, now_s, self._repairs)):
            self._flow.round_trip.discard_sample()
        readers = self.readers
        least = readers.least_number if self.governing is None else readers.most_number
        if self.unsent and self.unsent[0][0] < least:
            self._skip_unwanted()
        acked_at = readers.least_at if readers.least_at < self._sent_at else self._sent_at
        if acked_at == self._sent_at:
            self._flow.restart_probe(now_s)
        if self.unsent:
            if readers.most_at >= self._sent_at:
                readers.reset_stall_timers(self._sent_at, now_s)
            first_at = acked_at if self.governing is None else readers.most_at
            may_reach, below = first_at + self._flow.window_bytes, least + FLIGHT_MESSAGES_MAX
            frames += self._new_frames(may_reach, below, limit - len(frames) if frames else limit)
        if frames and not self.cache.repaired and self._flow.round_trip.sample is None:
            self._flow.round_trip.handle_sent(self._sent_at, now_s)
        if not readers.active and not self.unsent:
            self._release_acknowledged()
        return frames

    def late_repairs_to_send(self, now_s: float, limit: int) -> list[bytes]:
        """Return at most ``limit`` frames to be sent again for readers that do not govern, once nothing new waits."""
        if self.unsent or not self._late_repairs.queue or limit <= 0:
            return []
        self._flow.round_trip.discard_sample()
        return self._repaired_frames(limit, now_s, self._late_repairs)

    def probe_due(self, now_s: float) -> bool:
        """Return whether readers have been silent for too long while something is under way; backs off."""
        return self.readers.least_at < self._sent_at and self._flow.probe_due(now_s)

    def get_timer(self) -> float:
        """Return the monotonic second of the next probe, or at which a reader becomes slow; infinity: never."""
        readers, flow = self.readers, self._flow
        due_s = NEVER_S if readers.least_at == readers.most_at else readers.next_slow()
        return flow.probe_at_s if readers.least_at < self._sent_at and flow.probe_at_s < due_s else due_s

    def _repaired_frames(self, limit: int, now_s: float, repairs: RetransmissionQueue) -> list[bytes]:
        """Return at most ``limit`` frames to be sent again; what arrived since it was requested is left out."""
        messages, acked_at = self.cache.messages, self._acked_at()
        least = self.readers.least() if self.readers.suspended else 0

        def is_lacked(number: int, part: int) -> bool:
            return messages[number].position(part) >= acked_at or number >= least > 0

        frames = repairs.frames_to_send(self.cache, limit, now_s, is_lacked)
        self.retransmissions += len(frames)
        return frames

    def _new_frames(self, may_reach: int, below: int, limit: int) -> list[bytes]:
        """Return at most ``limit`` frames that were never sent, up to a position, of messages below a number."""
        frames: list[bytes] = []
        unsent = self.unsent
        while unsent and self._sent_at < may_reach and limit > 0 and unsent[0][0] < below:
            number, part = unsent[0]
            message = self.cache.messages[number]
            begin_at, count = message.begin_at, limit
            self._sent_at = begin_at if begin_at > self._sent_at else self._sent_at  # what lies before it was cancelled
            if begin_at + message.size > may_reach:
                count = min(max(1, (may_reach - self._sent_at) // len(message.frames[0])), limit)
            batch = message.frames[part : part + count]
            frames += batch
            sent = len(batch)
            limit -= sent
            if sent == count and part + sent < len(message.frames):
                self._sent_at += sum(map(len, batch))
                unsent[0] = (number, part + sent)
            else:
                self._sent_at = begin_at + message.size
                unsent.popleft()
        if not unsent:
            self._sent_at = self.cache.end_at
        return frames

    def _skip_unwanted(self) -> None:
        """Do not send what no active reader lacks; a suspended one gets it as a repair once it reports again."""
        least = self.readers.least_number if self.readers.active else 0
        if not self.unsent or self.unsent[0][0] >= least:
            return
        while self.unsent and self.unsent[0][0] < least:
            self._sent_at = self.cache.messages[self.unsent.popleft()[0]].end_at
            for reader in self.readers.active.values():
                reader.acked_at = max(reader.acked_at, self._sent_at)
        self.readers.refresh()

    def _budget_now(self) -> int:
        """Return how many bytes may be cached: fewer if the oldest message is cached for suspended readers alone."""
        oldest, readers = self.cache.oldest, self.readers
        is_spare = len(self.cache.messages) > self.cache.depth
        is_spare = is_spare and oldest is not None and oldest < readers.least_number
        return self._budget_bytes if readers.suspended and is_spare else 2 * self._budget_bytes

    def _request_repairs(self, reader: bytes, acknack: AckNack, now_s: float, trip_s: float) -> None:
        """Queue the fragments that a reader lacks."""
        position = self.readers.active.get(reader) or self.readers.suspended[reader]
        is_late = self.governing not in (None, reader)
        (self._late_repairs if is_late else self._repairs).request(
            acknack.missing,
            position.allowance,
            self.cache,
            sent_at=self._sent_at,
            rtt_s=max(self._flow.round_trip.rtt_s or 0.0, trip_s),
            round_bytes=REPAIRS_MAX_BYTES,
            now_s=now_s,
        )

    def _acked_at(self) -> int:
        """Return the position that every active reader has acknowledged; that of what was sent without one."""
        return min(self.readers.least_at, self._sent_at)

    def _release_acknowledged(self) -> None:
        released = self.cache.beyond_depth(self._now_s, self.readers.least())
        while released and self.readers.active:
            newest = self.cache.messages[released[-1]]
            if newest.begin_at + newest.size <= self._sent_at:
                break
            del released[-1]
        if released:
            self._release(released)

    def _release(self, numbers: list[int]) -> None:
        """Remove messages, whose numbers rise; none of them is sent."""
        end_at = 0
        for number in numbers:
            message = self.cache.remove(number)
            end_at = message.begin_at + message.size
        if self._cancelled:
            self._cancelled.difference_update(numbers)
        self._sent_at = end_at if end_at > self._sent_at else self._sent_at
        while self.unsent and self.unsent[0][0] <= numbers[-1]:
            self.unsent.popleft()

    def _forget(self, number: int) -> CachedMessage:
        if self._cancelled:
            self._cancelled.discard(number)
        return self.cache.remove(number)
