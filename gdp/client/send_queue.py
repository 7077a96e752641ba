"""Send queue of a writer: numbers, bundles and seals messages, and refragments them when the path MTU drops.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A message passes up to three stages::

    deferred (kept, before the first reader) -> gathered (small, waits for its bundle) -> sealed (window or queue)

A message is sealed once. If the path becomes too narrow for a cached message, it is refragmented, and everything cached
gets new numbers. Heartbeats announce the new numbers (``gdp/message/renumbering.py``). Each message has a sequence
number under its seal, sent or not (``gdp/message/ledger.py``).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from gdp.client.best_effort_queue import BestEffortQueue, Carried, is_expired
from gdp.client.deferred_messages import DeferredMessages
from gdp.client.key_epochs import KeyEpochs
from gdp.client.message_recorder import MessageRecorder
from gdp.client.parity_sender import PARITY_BYTES, is_protected
from gdp.client.send_options import PublisherSettings, SendOptions
from gdp.client.sequence_numbers import SequenceState
from gdp.crypto.envelope import SIGNATURE_BYTES, Sealed, fragment_capacity
from gdp.errors import DropReason
from gdp.frame.codec import Flag
from gdp.limits import SEQUENCE_BYTES, WINDOW_BYTES
from gdp.message.bundle import BUNDLE_BYTES, LENGTH_BYTES, SMALL, Gathered, pack
from gdp.message.ledger import Ledger
from gdp.message.loss import LossReason
from gdp.message.renumbering import MOVES_MAX, Renumbering
from gdp.message.send_window import SendWindow
from gdp.sansio import new_tuple

_BUNDLE: Final = int(Flag.BUNDLE)
_PARITY: Final = int(Flag.PARITY)
_RELIABLE: Final = int(Flag.RELIABLE)
_LATCHED: Final = int(Flag.LATCHED)
_URGENT: Final = int(Flag.URGENT)
_FORGET_EVERY: Final = 64  # messages, after which the ledger forgets those that are no longer cached


class SendQueue:
    """Messages of one writer, from the call that publishes them to their frames.

    Args:
        keys: seals the frames.
        window: caches the frames of a topic whose readers acknowledge.
        settings: of the publisher.
        past: last numbers of an earlier one.

    Attributes:
        deferred: messages that wait for the first reader.
        is_acknowledged: readers acknowledge what they get (reliable or latched topics).
        depth: latched messages for late joiners.
        awaited: messages kept for readers that waited before they were published.
        flags: header flags of every frame.
        mtu: smallest on the path, in bytes after the Ethernet header; None: unknown.
        bundle_bytes: largest bundle; 0: each message has a seal of its own.
        moves: the latest renumberings.
        drops: messages dropped here, by reason.
        bytes_s: bytes of frames per second that this topic may send now; None: unknown, or there is no deadline.
        pace_of: returns the pace of a best-effort message of so many bytes that begins to leave.
        has_parity: messages sealed from now on leave space for parity frames, and announce them.
        recorder: gets what is sealed, for a capsule, and what is dropped unsealed; None: there is none.
    """

    def __init__(
        self, *, keys: KeyEpochs, window: SendWindow, settings: PublisherSettings, past: SequenceState
    ) -> None:
        self._keys = keys
        self._window = window
        self._settings = settings
        self.next_number = past.next_number
        self.ledger = Ledger(past.sequence)
        self.awaited = 0
        self.mtu: int | None = None
        self.bundle_bytes = BUNDLE_BYTES
        self._note_depth(settings.depth)
        self.moves: deque[Renumbering] = deque(maxlen=MOVES_MAX)
        self.drops: Counter[DropReason] = Counter()
        self.deferred = DeferredMessages(self.ledger)
        self._gathered = Gathered()
        self.options = options = settings.options
        self.bytes_s: float | None = None
        self.has_parity = False
        self.recorder: MessageRecorder | None = None
        self.pace_of: Callable[[int], int] = lambda _size: 0
        self._best_effort = BestEffortQueue(options.deadline_s)
        window.set_history_bounds(options.history_bytes, options.history_age_s)

    @property
    def is_empty(self) -> bool:
        """Return whether nothing waits outside the window."""
        return not (self.deferred.waiting or self._gathered.messages or self._best_effort.waiting)

    def has_space(self) -> bool:
        """Return whether a message may be added without evicting an unacknowledged one."""
        return self._window.has_space() and self._gathered.held_bytes < WINDOW_BYTES

    @property
    def oldest(self) -> int:
        """Return the first message number that is cached, or will be."""
        oldest = self._window.cache.oldest
        return self.next_number if oldest is None else oldest

    @property
    def first_waiting(self) -> int:
        """Return the first sequence number that has no message number yet, or the next one."""
        if self.deferred.waiting:
            return self.deferred.waiting[0][0]
        return self._gathered.first if self._gathered.messages else self.ledger.last + 1

    @property
    def sent(self) -> tuple[int, int]:
        """Return the message number and the fragment before which everything has been sent."""
        if self.is_acknowledged:
            return self._window.sent
        waiting = self._best_effort.oldest
        return (self.next_number if waiting is None else waiting.number), 0

    @property
    def sent_sequence(self) -> int:
        """Return the sequence number of what is sent next."""
        if self.is_acknowledged:
            return self.ledger.begin_of(self._window.sent[0], self.first_waiting)
        waiting = self._best_effort.oldest
        return self.first_waiting if waiting is None else waiting.sequence

    @property
    def kept(self) -> int:
        """Return how many messages stay for readers that come later."""
        return max(self.depth, self.awaited)

    def await_readers(self, awaited: int) -> None:
        """Change how many messages are kept for readers that waited before they were published."""
        self.awaited = awaited
        self.set_depth(self.depth)

    def defer(self, message: bytes, added_s: float | None = None) -> None:
        """Queue a latched message for the first reader; the oldest beyond the history are dropped.

        Args:
            added_s: when it is published; None: it does not age.
        """
        self.deferred.add(message, added_s)
        self.deferred.drop_beyond(self.kept, self.options, added_s, is_latched=self.depth > 0)

    def drop_aged(self, now_s: float) -> None:
        """Drop what is too old for late joiners."""
        if self.options.history_age_s is not None:
            self._window.release_aged(now_s)
            self.deferred.drop_beyond(self.kept, self.options, now_s, is_latched=self.depth > 0)

    def add(self, message: bytes, *, gather_bytes: int, added_s: float | None = None, head: bytes = b"") -> None:
        """Queue a message; small ones wait to be bundled, up to ``gather_bytes`` of them.

        Args:
            added_s: when it is published; None: when frames are polled next.
            head: goes before it under the seal.

        Raises:
            LocalError: above the limits.
        """
        gathered, most = self._gathered, self._frame_capacity
        if self.deferred.waiting:
            self.seal_deferred()
        most = most if most < self.bundle_bytes else self.bundle_bytes
        if self.depth or SMALL * (len(head) + len(message) + LENGTH_BYTES) > most:
            self.seal_gathered()
            self._seal_message(message, self.ledger.last + 1, added_s=added_s, head=head)
            self.ledger.next(added_s)
            return
        gathered.add(self.ledger.next(added_s), head + message, added_s)
        if gathered.held_bytes > gather_bytes:
            self._seal_next()

    def skip(self, reason: LossReason, now_s: float | None = None) -> None:
        """Use up a sequence number for a message that no reader gets."""
        self.seal_gathered()
        sequence = self.ledger.next(now_s)
        self.ledger.lose(sequence, sequence, reason)

    def set_options(self, options: SendOptions) -> None:
        """Change how fresh best-effort messages leave, those that wait included."""
        self.options = options
        self._best_effort.deadline_s = options.deadline_s
        self._window.set_history_bounds(options.history_bytes, options.history_age_s)

    def set_depth(self, depth: int) -> None:
        """Change how many messages are latched; what is beyond that is dropped."""
        self.seal_gathered()
        self._note_depth(depth)
        self._window.set_history_depth(self.kept, self.next_number)
        dropped = self.deferred.drop_beyond(self.kept, self.options, None, is_latched=self.depth > 0)
        self.drops[DropReason.NO_READER] += dropped

    def _note_depth(self, depth: int) -> None:
        self.depth = depth
        reliable, urgent = self._settings.reliable, self._settings.urgent
        self.is_acknowledged = reliable or depth > 0
        self.flags = _RELIABLE * reliable | _LATCHED * (depth > 0) | _URGENT * urgent
        self._frame_capacity = BUNDLE_BYTES
        if not self.is_acknowledged and self.mtu is not None:  # one frame: the loss of one loses the whole bundle
            self._frame_capacity = fragment_capacity(self.mtu) - SIGNATURE_BYTES - SEQUENCE_BYTES

    def set_mtu(self, mtu: int) -> None:
        """Set how many bytes each frame may have, from the header on."""
        self.mtu = mtu
        self._note_depth(self.depth)

    def seal_deferred(self) -> None:
        """Seal what waited for the first reader."""
        while self.deferred.waiting:
            sequence, message, added_s = self.deferred.pop()
            self._seal_message(message, sequence, added_s=added_s, is_recorded=True)

    def seal_gathered(self) -> None:
        """Seal what waited to be bundled."""
        while self._gathered.messages:
            self._seal_next()

    def drop_expired(self, now_s: float) -> bool:
        """Drop best-effort messages that would come too late; return whether there were any. None is sealed for it."""
        if self.is_acknowledged:
            return False
        gathered, best_effort, options, dropped = self._gathered, self._best_effort, self.options, 0
        expired = best_effort.waiting and best_effort.drop_expired(
            now_s, self.bytes_s, is_followed=bool(gathered.messages)
        )
        for each in expired or ():
            self._lose(each.sequence, each.messages, DropReason.LIFESPAN, LossReason.LIFESPAN)
            dropped += each.messages
        while gathered.messages:
            waited_s, has_newer = now_s - gathered.oldest_added_s(now_s), len(gathered.messages) > 1
            if not is_expired(waited_s, gathered.oldest_bytes, options.deadline_s, self.bytes_s, has_newer=has_newer):
                break
            if self.recorder is not None:
                self.recorder.add(gathered.messages[0][0], gathered.first)
            self._lose(gathered.drop_oldest(), 1, DropReason.LIFESPAN, LossReason.LIFESPAN)
            dropped += 1
        return bool(dropped)

    def drop_unread(self) -> None:
        """Drop best-effort messages that wait: their readers are gone."""
        for each in self._best_effort.drop_all():
            self._lose(each.sequence, each.messages, DropReason.NO_READER, LossReason.NO_READER)
        while self._gathered.messages and not self.is_acknowledged:
            if self.recorder is not None:
                self.recorder.add(self._gathered.messages[0][0], self._gathered.first)
            self._lose(self._gathered.drop_oldest(), 1, DropReason.NO_READER, LossReason.NO_READER)

    def frames_to_send(self, now_s: float, limit: int) -> list[bytes]:
        """Return about ``limit`` frames that may be sent now, at least one; the rest is sealed when it is polled."""
        window, best_effort, messages = self._window, self._best_effort, self._gathered.messages
        left = limit if limit > 0 else 1
        frames = best_effort.poll_frames(left, self.pace_of) if best_effort.waiting else []
        if window.cache.messages and (not messages or window.has_frames):
            frames += window.frames_to_send(now_s, max(left - len(frames), 1) if frames else left)
        while messages:
            left = limit - len(frames) if frames else limit
            if left <= 0 or (window.unsent if self.is_acknowledged else best_effort.waiting):
                break
            self._seal_next()
            frames += (
                window.frames_to_send(now_s, left)
                if self.is_acknowledged
                else best_effort.poll_frames(left, self.pace_of)
            )
        return frames

    def refragment_best_effort(self, mtu: int) -> bool:
        """Seal unsent best-effort messages again if one is too large for the path; return whether any was."""
        requeued = self._best_effort.requeue(mtu)
        for body, carried in requeued:
            self._seal_message(body, carried.sequence, carried.messages, carried.added_s, is_recorded=True)
        return bool(requeued)

    def refragment(self, mtu: int, *, is_forced: bool = False) -> Renumbering | None:
        """Seal all that is cached again, under new numbers, if something is too large for the path.

        Args:
            is_forced: also if everything fits, because the key has changed.

        Returns:
            the renumbering, or None if nothing is sealed again.
        """
        cached = [
            (number, each.frames)
            for number, each in self._window.cache.messages.items()
            if isinstance(each.frames, Sealed)
        ]
        if not cached or not (is_forced or any(each.largest > mtu for _, each in cached)):
            return None
        first, end = cached[0][0], self.next_number
        move = Renumbering(first, end - first, end + 1)
        is_bundle = self.ledger.is_bundle
        sealed = [
            (move.new_number(number), self._seal(move.new_number(number), each, mtu, is_bundle=is_bundle(number)))
            for number, each in cached
        ]
        self.ledger.forget(first)
        self.ledger.move(move)
        self.next_number = move.new_number(end)
        self.moves.append(move)
        self._window.renumber(move, [(number, each, each.size_bytes) for number, each in sealed])
        return move

    def close(self) -> None:
        """Drop what waits; nothing is sent any more."""
        deferred = self.deferred.drop_beyond(0, self.options, None, is_latched=self.depth > 0)
        self.drops[DropReason.NO_READER] += len(self._gathered.messages) + deferred
        self._gathered, self._best_effort = Gathered(), BestEffortQueue(self.options.deadline_s)

    def _seal_next(self) -> None:
        """Seal the part of the gathered messages that fits into one bundle."""
        most = self._frame_capacity if self._frame_capacity < self.bundle_bytes else self.bundle_bytes
        first, (together, added_s) = self._gathered.first, self._gathered.poll_batch(most)
        count = len(together)
        self._seal_message(together[0] if count == 1 else pack(together), first, count, added_s)

    def _seal_message(
        self,
        body: bytes,
        sequence: int,
        messages: int = 1,
        added_s: float | None = None,
        head: bytes = b"",
        *,
        is_recorded: bool = False,
    ) -> None:
        """Number and seal a message, or a bundle of several; the oldest are dropped when too much waits."""
        assert self.mtu is not None
        if self.recorder is not None:
            self.recorder.seal_unsent()
        number, ledger = self.next_number, self.ledger
        prefix = sequence.to_bytes(SEQUENCE_BYTES, "big") + head
        frames = self._seal(number, body, self.mtu, is_bundle=messages > 1, prefix=prefix)
        self.next_number += 1
        if self.recorder is not None and not is_recorded:
            self.recorder.on_sealed(frames, sequence, messages)
        if not self.is_acknowledged:
            for dropped in self._best_effort.add(frames, new_tuple(Carried, (number, sequence, messages, added_s))):
                self._lose(dropped.sequence, dropped.messages, DropReason.MEMORY_FULL, LossReason.QUEUE_OVERFLOW)
            return
        ledger.put(number, sequence, messages)
        evicted = self._window.add(number, frames, frames.size_bytes, added_s)
        if evicted:
            self.drops[DropReason.MEMORY_FULL] += ledger.record_evicted(evicted, LossReason.WINDOW_OVERFLOW)
        if not number % _FORGET_EVERY:
            ledger.forget(self.oldest)

    def _seal(self, number: int, body: bytes | Sealed, mtu: int, *, is_bundle: bool, prefix: bytes = b"") -> Sealed:
        flags = self.flags | _BUNDLE * is_bundle
        if self.has_parity:
            size = len(prefix) + (len(body) if isinstance(body, bytes) else body.message_bytes)
            if is_protected(size, mtu):
                return self._keys.data.seal(number, flags | _PARITY, body, mtu - PARITY_BYTES, prefix)
        return self._keys.data.seal(number, flags, body, mtu, prefix)

    def _lose(self, sequence: int, messages: int, drop_reason: DropReason, reason: LossReason) -> None:
        """Count messages that no reader gets."""
        self.drops[drop_reason] += messages
        self.ledger.lose(sequence, sequence + messages - 1, reason)
