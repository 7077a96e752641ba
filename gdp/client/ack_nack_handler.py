"""Acknowledgement handling of a writer: its readers, their first messages, and what their reports confirm.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A silent reader is suspended: it blocks nothing, and what it lacks is cached for a grace time, as far as the cache
allows. A reader that stalls, or lags while others have acknowledged, no longer blocks the window. It still gets what is
sent, and skips what is gone. After a penalty it may block the window again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gdp.client.heartbeat_schedule import HeartbeatSchedule
from gdp.client.reader_proxies import ReaderProxies, ReaderProxy
from gdp.client.send_queue import SendQueue
from gdp.client.sent_frames import SentFrames
from gdp.intervals import READER
from gdp.message.acknack import AckNack, AckNackFlag
from gdp.message.heartbeat import Heartbeat, StreamStart
from gdp.message.loss import LossReason
from gdp.message.renumbering import Renumbering
from gdp.message.send_window import SendWindow

_SETTLED_S: Final = 0.25  # after the last message of a best-effort topic, a Heartbeat states that it was the last


class AckNackHandler:
    """Acknowledgement handler: processes the AckNacks of the readers of one writer.

    Args:
        readers: the known readers.
        heartbeats: when a Heartbeat is due, and where new readers begin.
        sent_frames: when frames were last sent.
    """

    def __init__(
        self,
        *,
        readers: ReaderProxies,
        queue: SendQueue,
        window: SendWindow,
        heartbeats: HeartbeatSchedule,
        sent_frames: SentFrames,
    ) -> None:
        self._readers = readers
        self._queue = queue
        self._window = window
        self._heartbeats = heartbeats
        self._sent_frames = sent_frames

    @property
    def acknowledged(self) -> int:
        """Return how many messages every reader has confirmed; of a best-effort topic, how many were sent."""
        queue, readers = self._queue, self._readers.all()
        if not queue.is_acknowledged:
            return self.sent
        below = min([queue.first_waiting, *(each.sequence for each in readers)])
        return min(queue.ledger.confirmed(below), max(queue.ledger.messages - self.reader_lost, 0))

    @property
    def sent(self) -> int:
        """Return how many messages have left, not counting those that some reader is known not to get."""
        return self._queue.ledger.confirmed(self._queue.sent_sequence)

    @property
    def reader_lost(self) -> int:
        """Return how many messages the reader that lost most reports as lost, those that never left included."""
        return max((each.lost for each in self._readers.all()), default=0)

    def is_reported(self) -> bool:
        """Return whether nothing waits, and every reader has reported each message as delivered or lost."""
        last = self._queue.ledger.last
        return self._queue.is_empty and all(each.sequence > last for each in self._readers.all())

    def handle_acknack(self, name: bytes, acknack: AckNack, *, is_new: bool, now_s: float, trip_s: float = 0.0) -> None:
        """Process a report that was opened.

        Args:
            is_new: the reader, or this incarnation of it, was unknown before.
            trip_s: round trip of its path; 0: not known.
        """
        queue, ledger = self._queue, self._queue.ledger
        reader, sequence = self._readers.active[name], min(acknack.sequence, ledger.last + 1)
        if is_new:
            self._drop(name)
            reader.sequence = sequence or self._readers.confirmed.get(name) or queue.first_waiting
        if acknack.flags is AckNackFlag.BYE:
            self.forget(name)
            if not self._readers.all():
                ledger.give_up(max(sequence, reader.sequence), ledger.last, LossReason.NO_READER)
            return
        if queue.moves:
            acknack = self._translate(acknack)
        if acknack.flags is AckNackFlag.NEW:
            self._start(name, acknack, now_s)
            return
        reader.start = None
        if queue.is_acknowledged:
            self._acknowledge(name, acknack, is_new=is_new, now_s=now_s, trip_s=trip_s)
        if name not in self._window.readers.suspended:
            reader.behind_s = None
        if is_new or sequence > reader.sequence:
            reader.advanced_s = now_s
        reader.sequence = sequence if sequence > reader.sequence else reader.sequence
        reader.lost = acknack.lost if acknack.lost > reader.lost else reader.lost
        if sequence > ledger.last:
            return
        if queue.is_acknowledged:
            is_settled = acknack.next_number >= self._window.sent[0]
        else:
            is_stuck = now_s - reader.advanced_s >= READER.refresh_s
            is_settled = is_stuck or now_s - self._sent_frames.last_s > _SETTLED_S
        if is_settled and acknack.sequence < queue.sent_sequence:
            self._heartbeats.is_reminder_wanted = True  # it does not know what it has lost behind its last message

    def poll_heartbeat(self, now_s: float, trip_s: float, paces: tuple[tuple[bytes, int], ...] = ()) -> bytes:
        """Return the wire form of the Heartbeat that is due.

        Args:
            trip_s: how long a reader's answer may take.
            paces: that readers are to state.
        """
        return self._heartbeats.poll_heartbeat(self._place(paces), now_s, trip_s)

    def describe_heartbeat(self) -> tuple[int, bytes]:
        """Return number and wire form of a Heartbeat that brings the description, and starts no reader."""
        return self._heartbeats.describe_apart(self._place(()))

    def _place(self, paces: tuple[tuple[bytes, int], ...]) -> Heartbeat:
        """Return what is cached, sent, renumbered and gone."""
        queue, oldest = self._queue, self._window.cache.oldest
        (sent_number, sent_part), sent_sequence = queue.sent, queue.sent_sequence
        return Heartbeat(
            oldest=sent_number if oldest is None else oldest,
            sent_number=sent_number,
            sent_part=sent_part,
            starts={},
            description=b"",
            moves=tuple(queue.moves),
            oldest_sequence=sent_sequence if oldest is None else queue.ledger.begin_of(oldest, sent_sequence),
            sent_sequence=sent_sequence,
            gone=tuple(queue.ledger.gone),
            paces=paces,
        )

    def handle_timer(self, now_s: float) -> None:
        """Suspend silent readers, drop slow ones from the window, and give up what was suspended for too long."""
        for name in self._readers.silent(now_s):
            self._window.readers.suspend(name)
            self._readers.suspend(name, now_s)
            self._heartbeats.starts.pop(name, None)
        for name in self._window.slow_readers(now_s):
            if self._readers.is_quiet(name, now_s):
                self._window.readers.suspend(name)
                self._readers.active[name].behind_s = now_s
            else:
                self.exclude(name, now_s)
        for name, reader in self._readers.overdue(now_s):
            self._give_up(name, reader, now_s)

    def lose_ended(self, numbers: Sequence[int]) -> None:
        """Count requests that some server will not get, because their call has ended; a Heartbeat says so at once."""
        if numbers:
            self._queue.ledger.record_evicted(numbers, LossReason.CALL_ENDED)
            self._heartbeats.wanted = True

    def exclude(self, name: bytes, now_s: float) -> None:
        """Let a slow reader block the others no longer, for a penalty time."""
        if name in self._window.readers.active or (name in self._readers.active and not self._queue.is_acknowledged):
            self._readers.suspend_again(name, now_s)
            self._window.drop_reader(name)
            self._heartbeats.wanted = True

    def connect(self, name: bytes, incarnation: int, exchange: bytes, now_s: float) -> None:
        """Make a reader active that is known without an introduction; an active one is left unchanged.

        Args:
            exchange: its X25519 key.

        Raises:
            StatementError: MALFORMED, ``exchange`` is no key.
        """
        if name in self._readers.active:
            return
        if not self._readers.resume(name, now_s):
            self._readers.record_key(name, incarnation, 0, exchange)
            self._readers.admit(name, incarnation, now_s).sequence = self._queue.first_waiting
        self._readers.active[name].behind_s = None
        if name in self._window.readers.suspended:
            self._window.readers.resume(name, now_s)
        else:
            self._window.add_reader(name, self._queue.next_number, now_s)

    def renumber(self, move: Renumbering) -> None:
        """Translate the start numbers of new readers, after everything cached got new numbers."""
        starts = self._heartbeats.starts
        for name, start in starts.items():
            starts[name] = start._replace(number=move.new_number(start.number))
        for reader in self._readers.all():
            if reader.start is not None:
                reader.start = reader.start._replace(number=move.new_number(reader.start.number))
        self._heartbeats.wanted = True

    def forget(self, name: bytes) -> None:
        """Forget a reader."""
        if self._readers.forget(name):
            self._drop(name)

    def close(self) -> None:
        """Forget every reader, and count what it has not confirmed as given up."""
        ledger = self._queue.ledger
        for reader in self._readers.all():
            ledger.give_up(reader.sequence, ledger.last)
        for name in self._readers.names():
            self.forget(name)

    def _drop(self, name: bytes) -> None:
        self._heartbeats.starts.pop(name, None)
        self._window.drop_reader(name)

    def _give_up(self, name: bytes, reader: ReaderProxy, now_s: float) -> None:
        """Cache nothing more for a reader whose window has been suspended for too long."""
        self._queue.seal_gathered()  # it is given up, too
        self._queue.ledger.give_up(reader.sequence, self._queue.ledger.last)
        if self._readers.is_suspended(name):
            self._readers.give_up(name)
            self._drop(name)
        else:  # it is alive, and cannot catch up
            self._window.drop_reader(name)
            self._readers.suspend_again(name, now_s)
            reader.behind_s = None
        self._heartbeats.wanted = True

    def _translate(self, acknack: AckNack) -> AckNack:
        """Return a report under the present numbers; a Heartbeat announces them to a reader that does not know them."""
        for move in self._queue.moves:
            if move.is_before(acknack.next_number):
                acknack = acknack._replace(next_number=move.new_number(acknack.next_number), next_part=0, missing=())
                self._heartbeats.is_reminder_wanted = True
        return acknack

    def _start(self, name: bytes, acknack: AckNack, now_s: float) -> None:
        """Choose the first message of a new reader; a repeated request gets the same response."""
        reader, queue = self._readers.active[name], self._queue
        if name not in self._heartbeats.starts and not self._heartbeats.is_full:
            queue.seal_gathered()  # it was published before this reader came
            oldest = self._window.cache.oldest
            is_gone = oldest is not None and reader.start is not None and reader.start.number < oldest
            if reader.start is None or is_gone or not queue.is_acknowledged:
                since_s = now_s - acknack.held_us / 1e6  # since when it waits
                number = self._first_of(acknack, since_s)
                waiting = number - queue.next_number
                begin = queue.ledger.begin_of(number, queue.first_waiting)
                if 0 < waiting < len(queue.deferred.waiting):
                    begin = queue.deferred.waiting[waiting][0]
                if queue.is_acknowledged and not (queue.depth or acknack.next_number):
                    begin = min(queue.ledger.first_since(since_s), begin)  # what was published in between is lost
                if reader.start is not None:  # it is a reader since then: what it did not get since is lost
                    begin = min(reader.start.sequence, begin)
                reader.start = StreamStart(reader.incarnation, number, begin, self._readers.confirmed.get(name, 0))
                reader.sequence = min(acknack.sequence, queue.ledger.last + 1) or begin
                if queue.is_acknowledged and now_s >= reader.out_until_s:
                    self._window.add_reader(name, number, now_s)
                    if number < queue.next_number and acknack.next_number and len(self._window.readers.active) > 1:
                        self._window.readers.suspend(name)  # the others must not wait for what it missed
                        reader.behind_s = now_s
            self._heartbeats.starts[name] = reader.start
        self._heartbeats.wanted = True

    def _first_of(self, acknack: AckNack, since_s: float) -> int:
        """Return the message number at which a reader begins: where it was before, or with the next message.

        One that waited before a message was published gets that message, while it is kept for such readers.
        """
        queue = self._queue
        if acknack.next_number and queue.is_acknowledged:
            return min(max(acknack.next_number, queue.oldest), queue.next_number)
        if queue.depth:
            return max(queue.oldest, queue.next_number + len(queue.deferred.waiting) - queue.depth)
        if not queue.awaited:
            return queue.next_number
        if (cached := self._window.cache.first_since(since_s)) is not None:
            return cached
        return queue.next_number + queue.deferred.count_before(since_s)

    def _acknowledge(self, name: bytes, acknack: AckNack, *, is_new: bool, now_s: float, trip_s: float) -> None:
        reader, window, queue = self._readers.active[name], self._window, self._queue
        if acknack.missing:
            self.lose_ended(window.poll_cancelled(acknack))
        lacks_from = acknack.missing[0].number if acknack.missing and not is_new else acknack.next_number
        is_gone = lacks_from not in window.cache.messages and lacks_from < queue.oldest
        if not (name in window.readers.active or name in window.readers.suspended) and now_s >= reader.out_until_s:
            # it lagged; what a forgotten reader lacked was given up before
            oldest = queue.oldest
            if not is_new and acknack.next_number < oldest:
                end = queue.ledger.begin_of(oldest, queue.first_waiting)
                queue.ledger.give_up(acknack.sequence, end - 1)
            window.add_reader(name, min(max(acknack.next_number, oldest), queue.next_number), now_s)
        if name in window.readers.active or name in window.readers.suspended:
            window.handle_acknack(name, acknack, now_s, trip_s)
        if is_gone or (name in window.readers.suspended and not acknack.missing):
            self._heartbeats.is_reminder_wanted = True  # it requests what is gone, or does not know what it lacks
