"""Writer of one topic.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``poll_frames`` returns the frames for the switch.

The writer joins ``send_queue.py`` (numbers, bundles and seals), ``gdp/message/send_window.py`` (caches and repairs),
``sent_frames.py`` (what has left), ``protection.py`` (what is sent against loss), ``governing_paths.py`` (how much may
leave), ``ack_nack_handler.py`` (readers and what they confirm), ``key_epochs.py`` and ``heartbeat_schedule.py``.

Small messages wait until frames are polled, and become one bundle, sealed and signed once. A latched topic has no
bundles, because its late joiners get a fixed number of messages. Without a reader nothing is sealed; the last ``depth``
messages of a latched topic wait for late joiners.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gdp.client.ack_nack_handler import AckNackHandler
from gdp.client.governing_paths import GoverningPaths
from gdp.client.heartbeat_schedule import HeartbeatSchedule
from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import KeyEpochs, Secrets
from gdp.client.message_recorder import MessageRecorder, OnSealed
from gdp.client.protection import Protection
from gdp.client.reader_path import ReaderPaths
from gdp.client.reader_proxies import ReaderProxies
from gdp.client.send_options import RELIABLE, PublisherSettings, SendOptions
from gdp.client.send_queue import SendQueue
from gdp.client.sent_frames import SentFrames
from gdp.client.sequence_numbers import FIRST, SequenceState
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import SECOND_PATH, Header
from gdp.intervals import NEVER_S
from gdp.limits import MTU_MIN_BYTES, PACE_MAX, SPREAD, WINDOW_BYTES
from gdp.message.acknack import AckNackFlag
from gdp.message.bundle import BUNDLE_BYTES
from gdp.message.loss import LossReason
from gdp.message.send_window import SendWindow
from gdp.names import Name

_ALL: Final = 1 << 30
_AWAITED_MAX: Final = 64  # messages kept for readers that waited; as many as a latched topic of ROS keeps here


class Publisher:
    """Publisher of one topic.

    Args:
        secrets: topic secrets by epoch; the newest seals.
        description: what a reader must know to understand the messages; it is sent sealed.
        settings: what kind of stream it is.
        past: last numbers of an earlier publisher of the same topic, in this incarnation.
        address: destination of the frames; None: the topic.
        reader_paths: what may leave to each reader node; shared by all publishers of a participant.

    Attributes:
        paths: over how many paths its frames leave, as in its settings.
        is_urgent: its frames go before those of other topics.
        is_background: its frames leave when no others do.
        reader_paths: what may leave to each reader node.
        options: as set last.
        matched: its readers.
        queue: messages that wait, and the numbers of all.
        sent_frames: ledger of what has left.
        acknowledgements: what readers confirm.
        governing_paths: what may leave now.
        protection: what is sent against loss.
        drops: what was dropped, by reason.
        losses: which messages some reader did not get, as far as known here, and why.
        published: called when frames are ready to be polled, and when the publisher closes.
        has_more: the last ``poll_frames`` reached its limit.

    Raises:
        LocalError: there is no secret.
    """

    def __init__(
        self,
        *,
        topic: Name,
        source: WriterIdentity,
        secrets: Secrets,
        description: bytes,
        settings: PublisherSettings = RELIABLE,
        past: SequenceState = FIRST,
        address: Name | None = None,
        reader_paths: ReaderPaths | None = None,
    ) -> None:
        lag_s = settings.patience.lag_s
        self.topic = topic
        self._fastest_governs = settings.patience.fastest_governs
        self.paths, self.options, self.is_urgent = settings.paths, settings.options, settings.urgent
        self.is_background = settings.options.is_background
        self.has_more = False
        self.published: Callable[[Publisher], None] = lambda _: None
        self._awaits_until_s = NEVER_S
        self.reader_paths = ReaderPaths() if reader_paths is None else reader_paths
        self._keys = KeyEpochs(topic, source, secrets, address)
        self._window = SendWindow(history_depth=settings.depth, first_number=past.next_number, lag_s=lag_s)
        self.queue = SendQueue(keys=self._keys, window=self._window, settings=settings, past=past)
        self.drops = self.queue.drops
        self.losses = self.queue.ledger.losses
        self.matched = ReaderProxies(topic, source, settings.patience)
        self._heartbeats = HeartbeatSchedule(description, past.status_number)
        self.governing_paths = GoverningPaths(
            paths=self.reader_paths, readers=self.matched, queue=self.queue, window=self._window, settings=settings
        )
        self.sent_frames = SentFrames(
            self.reader_paths, counts_losses=settings.paths != SPREAD, paces=self.governing_paths.paces.stated
        )
        self.governing_paths.paces.is_under_way = self.sent_frames.is_under_way
        self.acknowledgements = AckNackHandler(
            readers=self.matched,
            queue=self.queue,
            window=self._window,
            heartbeats=self._heartbeats,
            sent_frames=self.sent_frames,
        )
        self.protection = Protection(
            source=source,
            keys=self._keys,
            readers=self.matched,
            queue=self.queue,
            window=self._window,
            paths=self.governing_paths,
            sent_frames=self.sent_frames,
            settings=settings,
        )

    @property
    def readers(self) -> int:
        """Return how many readers have introduced themselves and are alive; none before a tree is installed."""
        return 0 if self.queue.mtu is None else len(self.matched.active)

    def is_followed_by(self, name: Name, now_s: float, awake_s: float) -> bool:
        """Return whether a tree is installed, and a reader is alive and keeps up.

        Args:
            awake_s: monotonic second since which this participant has received without a stall.
        """
        keeps_up = name in self._window.readers.active or not self.confirms
        return self.queue.mtu is not None and keeps_up and self.matched.is_alive(name, now_s, awake_s)

    def cancel(self, sequence: int) -> None:
        """Send nothing more of a message, and repair nothing; bundled ones are small, and leave."""
        number = self.queue.ledger.number_of(sequence)
        if number is not None and self._window.cancel(number):
            self.protection.parity.cancel(number)
            self.acknowledgements.lose_ended([number])
            self.published(self)

    @property
    def is_wanted(self) -> bool:
        """Return whether a message published now is for a reader, or for one that may return to its window."""
        queue = self.queue
        is_read = self.matched.active or (queue.is_acknowledged and self._window.readers.suspended)
        return queue.mtu is not None and bool(is_read)

    @property
    def has_work(self) -> bool:
        """Return whether ``poll_frames`` may return frames, or has to drop some."""
        window, heartbeats, protection = self._window, self._heartbeats, self.protection
        is_changed = protection.entered != self.matched.changes or heartbeats.wanted or heartbeats.is_reminder_wanted
        is_held = self._fastest_governs or self.governing_paths.paces.slowing.blocks or protection.late.messages
        return bool(is_changed or is_held or not self.queue.is_empty or (window.cache.messages and window.has_frames))

    @property
    def confirms(self) -> bool:
        """Return whether readers acknowledge messages; those of a best-effort topic do not."""
        return self.queue.is_acknowledged

    @property
    def past(self) -> SequenceState:
        """Return the last numbers, for a later publisher of the same topic."""
        return SequenceState(self.queue.next_number, self._heartbeats.number, self.queue.ledger.last)

    @property
    def messages(self) -> int:
        """Return how many messages were published here, those without any possible reader included."""
        return self.queue.ledger.messages

    def has_space(self) -> bool:
        """Return whether a message may be published without evicting an unacknowledged one."""
        return self.queue.has_space()

    def is_acknowledged(self) -> bool:
        """Return whether every reader has confirmed everything, those that may return included."""
        return self.queue.is_empty and self._window.is_acknowledged()

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Replace the topic's secrets; messages from now on are sealed under the newest epoch.

        A Heartbeat announces the epoch to the readers. For ``EPOCH_GRACE_S`` their reports may still use the epoch
        before. Messages for late joiners, who may lack that epoch, are sealed again.

        Raises:
            LocalError: there is no secret.
        """
        if self.queue.recorder is not None:
            self.seal_recorded()  # under the epoch in which it was published
        if self._keys.renew(secrets, now_s):
            self._heartbeats.wanted = True
            self._record_description()
            mtu = self.queue.mtu
            move = self.queue.refragment(mtu, is_forced=True) if self.queue.depth and mtu is not None else None
            if move is not None:
                self.acknowledgements.renumber(move)
            self.published(self)

    def describe(self, description: bytes) -> None:
        """Change the description from now on; a Heartbeat brings it to present readers at once.

        If the frame of the Heartbeat is lost, the next messages may arrive before it.
        """
        if self._heartbeats.describe(description):
            self._record_description()
            self.published(self)

    def record(self, on_sealed: OnSealed, on_described: OnSealed) -> None:
        """Hand on each message as it is sealed, and each description before its messages; see ``MessageRecorder``."""
        self.queue.recorder = MessageRecorder(self.queue, self._keys, on_sealed, on_described)
        self._record_description()

    def seal_recorded(self) -> None:
        """Seal what waits, so that all that was published is recorded."""
        if self.queue.mtu is not None:
            self.queue.seal_gathered()
        if self.queue.recorder is not None:
            self.queue.recorder.seal_unsent()

    def _record_description(self) -> None:
        if self.queue.recorder is not None:
            self.seal_recorded()
            self.queue.recorder.record_description(*self.acknowledgements.describe_heartbeat())

    def probe(self) -> None:
        """Send a Heartbeat soon; each reader reports at once."""
        self._heartbeats.wanted = True
        self.published(self)

    def set_options(self, options: SendOptions) -> None:
        """Change how fresh, how much and how often messages leave, those that wait included."""
        self.options = options
        self.queue.set_options(options)
        self.governing_paths.set_options(options)
        self.protection.set_options()

    def await_readers(self, until_s: float) -> None:
        """Keep messages until a second for readers that waited before they were published.

        A reader waits as long as its subscription exists; the path to it comes later than the first messages.
        """
        if self.confirms:
            self._awaits_until_s = until_s
            self.queue.await_readers(_AWAITED_MAX)
            self.published(self)

    def set_depth(self, depth: int) -> None:
        """Change how many messages are kept for late joiners; 0: none."""
        if depth == self.queue.depth:
            return
        self.queue.set_depth(depth)
        if not self.confirms:  # the window is no longer used
            for name in self.matched.names():
                self._window.drop_reader(name)
        self._heartbeats.wanted = True
        self.published(self)

    def close(self) -> None:
        """Forget all readers and what waits for them; nothing is sent any more."""
        self.sent_frames.keep(())
        self.queue.close()
        self.protection.late.close()
        self.acknowledgements.close()
        self.published(self)  # the last time: the caller that waits for its frames finds none
        self.published = lambda _: None

    def tree_stands(self, mtu: int) -> bool:
        """Note that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header).

        Returns:
            whether something has to be sealed again for it.
        """
        mtu = max(mtu, MTU_MIN_BYTES)
        self.queue.set_mtu(mtu)
        self.matched.is_reachable = True
        self.reader_paths.tree_stands(self.matched.active, mtu)
        self.protection.late.drop_larger(mtu)
        is_resealed = self.queue.refragment_best_effort(mtu)
        move = self.queue.refragment(mtu)
        if move is not None:
            self.acknowledgements.renumber(move)
        return is_resealed or move is not None

    def publish(self, message: bytes, now_s: float | None = None, head: bytes = b"") -> int | None:
        """Queue a message; return the count of published messages, or None when there is no reader.

        The message is confirmed when ``acknowledged`` reaches that count.

        Args:
            now_s: from when it ages, on a best-effort topic; None: from when frames are polled next.
            head: first bytes of the message, so that a large one need not be copied; shorter than a frame.

        Raises:
            LocalError: above the limits.
        """
        if not self.is_wanted:
            if self.queue.kept:
                self.queue.defer(head + message, now_s)
                if self.queue.recorder is not None:
                    self.queue.recorder.add(head + message, self.queue.ledger.last)
            else:
                self.drops[DropReason.NO_READER] += 1
                self.skip(LossReason.NO_READER, now_s, head + message)
            return None
        gather_bytes = WINDOW_BYTES if self.matched.active else BUNDLE_BYTES
        self.queue.add(message, gather_bytes=gather_bytes, added_s=now_s, head=head)
        self.published(self)
        return self.queue.ledger.messages

    def skip(self, reason: LossReason, now_s: float | None = None, message: bytes = b"") -> None:
        """Count a message that has no reader: readers find it missing, and a Heartbeat gives the reason.

        Args:
            message: for the recorder; empty: it lacks the message, too.
        """
        self.queue.skip(reason, now_s)
        if message and self.queue.recorder is not None:
            self.queue.recorder.add(message, self.queue.ledger.last)
        if self.matched.active:
            self._heartbeats.wanted = True
            self.published(self)

    def receive_introduction(self, header: Header, frame: bytes) -> None:
        """Process the sealed introduction of a reader, whose reports open from then on; errors are counted."""
        try:
            if header.epoch != self._keys.epoch:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(header.epoch))
            self.matched.introduce(header, frame, self._keys.secret)
        except RemoteError as error:
            self.drops[error.reason] += 1

    def receive_acknack(self, header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> bool:
        """Process a reader's sealed report, which came ``waited_s`` before; return whether it is one.

        Errors are counted.
        """
        if self.sent_frames.leaving is not None:
            self.sent_frames.count()
        if self.queue.options.history_age_s is not None:
            self.queue.drop_aged(now_s)
        is_old = header.epoch != self._keys.epoch
        try:
            secret = self._keys.secret_of(header.epoch, now_s)
            report, is_new = self.matched.open(header, frame, secret, now_s, may_begin=not is_old)
        except RemoteError as error:
            is_copy = self.paths > 1 and error.reason is DropReason.REPLAYED
            self.drops[DropReason.SECOND_COPY if is_copy else error.reason] += 1
            return False
        source, hops = header.source, None if header.hops_left & SECOND_PATH else header.hops_left
        self.reader_paths.note_incarnation(source, self.matched.active[source].incarnation_id.started, now_s)
        if self.sent_frames.handle_report(source, report, now_s, waited_s, hops):
            self.drops[DropReason.UNPROVEN] += 1
        self.protection.handle_report(source, report, now_s, is_new=is_new)
        paces, is_paced = self.governing_paths.paces, report.flags is AckNackFlag.PACED
        if is_paced or paces.stated or paces.given:
            # a Heartbeat gives it another pace than it has stated to its switch, if it is to have one
            is_moved = paces.handle_report(source, report.share if is_paced else PACE_MAX, now_s)
            self._heartbeats.is_reminder_wanted |= is_moved
        if self._fastest_governs:
            self._window.governing = next(iter(self.governing_paths.fastest()), None)
        path = self.reader_paths.get(source) if report.missing else None  # repairs alone need its round trip
        trip_s = 0.0 if path is None else path.trip_s
        self.acknowledgements.handle_acknack(source, report, is_new=is_new, now_s=now_s, trip_s=trip_s)
        if report.missing:
            self.protection.request_late(source, report, now_s)
        self._heartbeats.is_reminder_wanted |= is_old  # it has not received the new epoch yet
        return True

    def handle_timer(self, now_s: float) -> None:
        """Suspend silent readers, drop slow ones from the window, and probe those that owe a report."""
        self.acknowledgements.handle_timer(now_s)
        for name in self.governing_paths.blocking.slow(now_s):
            self.acknowledgements.exclude(name, now_s)
        self._heartbeats.wanted |= self.governing_paths.paces.slow_down(now_s)
        self.governing_paths.paces.keep(self.matched.active)
        self.protection.late.drop_expired(now_s)
        if now_s >= self._awaits_until_s:
            self._awaits_until_s = NEVER_S
            self.queue.await_readers(0)
        self._heartbeats.wanted |= self._window.probe_due(now_s)
        self._heartbeats.handle_timer(now_s)

    def get_timer(self) -> float:
        """Return the monotonic second of the next timer; infinity: none."""
        protection, blocking, heartbeats = self.protection, self.governing_paths.blocking, self._heartbeats
        due_s = self.matched.next_silent()
        due_s = due_s if due_s < self._awaits_until_s else self._awaits_until_s
        if protection.late.messages or blocking.blocks:
            due_s = min(
                due_s, protection.late.get_timer(), blocking.get_timer(), self.governing_paths.paces.slowing.get_timer()
            )
        if self.queue.is_acknowledged and (window_s := self._window.get_timer()) < due_s:
            due_s = window_s
        if self.matched.active and self.queue.mtu is not None:
            is_wanted = heartbeats.wanted or heartbeats.is_reminder_wanted
            for each_s in (heartbeats.get_timer() if is_wanted else heartbeats.again_s, protection.copies.due_s):
                due_s = each_s if each_s < due_s else due_s
        return due_s

    def poll_frames(self, now_s: float, limit_bytes: int = _ALL) -> list[bytes]:
        """Return about ``limit_bytes`` of frames; the rest is sealed when it is polled.

        Heartbeats that are due leave in any case; with ``limit_bytes`` 0 nothing else does. ``sent_frames.count``
        follows, before another publisher asks what the same paths permit.
        """
        queue, mtu = self.queue, self.queue.mtu
        if self.sent_frames.leaving is not None:
            self.sent_frames.count()
        self.has_more = False
        if mtu is None or not self.matched.active:
            self.protection.copies.clear()
            self.protection.parity.clear()
            if not self.matched.active:
                queue.drop_unread()
            return []
        if queue.options.history_age_s is not None:
            queue.drop_aged(now_s)
        if queue.deferred.waiting:
            queue.seal_deferred()
        if not queue.is_acknowledged:
            queue.bytes_s = None if queue.options.deadline_s is None else self.governing_paths.bytes_s
            self._heartbeats.is_reminder_wanted |= queue.drop_expired(now_s)
        heartbeats: list[bytes] = []
        schedule = self._heartbeats
        if (schedule.wanted or schedule.is_reminder_wanted) and schedule.is_due(now_s):
            patience_s, paces = self.governing_paths.patience_s(now_s), self.governing_paths.paces.to_state()
            wire = self.acknowledgements.poll_heartbeat(now_s, patience_s, paces)
            heartbeats = self._keys.status.seal(schedule.number, queue.flags, wire, mtu)[:]
        frames = self.protection.poll_frames(now_s, limit_bytes, heartbeats)
        self.has_more = self.protection.has_more
        slowing = self.governing_paths.paces.slowing
        if self.has_more and len(self.matched.active) > 1 and not queue.is_empty:
            self.governing_paths.record_waiting(sum(map(len, frames)), now_s)
        elif slowing.blocks and queue.is_empty:
            slowing.blocks.clear()  # all that is published leaves in time
        return frames
