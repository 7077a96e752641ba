"""Writer of one topic.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``poll_frames`` returns the frames for the switch.

The writer joins ``send_queue.py`` (numbers, bundles and seals), ``gdp/message/send_window.py`` (caches and repairs),
``ack_nack_handler.py`` (readers and what they confirm), ``key_epochs.py`` (secrets) and ``heartbeat_schedule.py``.

Small messages wait until frames are polled, and become one bundle, sealed and signed once. A latched topic has no
bundles, because its late joiners get a fixed number of messages. Without a reader nothing is sealed; the last ``depth``
messages of a latched topic wait for late joiners.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

from gdp.client.ack_nack_handler import AckNackHandler
from gdp.client.heartbeat_schedule import HeartbeatSchedule
from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import KeyEpochs, Secrets
from gdp.client.reader_proxies import TOPICS, ReaderProxies, ReaderTimeouts
from gdp.client.send_queue import SendQueue
from gdp.client.sequence_numbers import FIRST, SequenceState
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import Header, second_path_copy
from gdp.frame.kinds import Flag
from gdp.limits import MTU_MIN_BYTES, SPREAD, WINDOW_BYTES
from gdp.message.bundle import BUNDLE_BYTES
from gdp.message.heartbeat import Heartbeat
from gdp.message.loss import Losses, LossReason
from gdp.message.send_window import SendWindow
from gdp.message.striping import Striper
from gdp.names import Name

__all__ = ["Publisher"]

_ALL: Final = 1 << 30


class Publisher:
    """Publisher of one topic.

    Args:
        secrets: topic secrets by epoch; the newest seals.
        description: what a reader must know to understand the messages; it is sent sealed.
        depth: how many messages late joiners get (0: none).
        urgent: its frames go before those of other topics, wherever they queue.
        past: last numbers of an earlier publisher of the same topic, in this incarnation.
        patience: timeouts of its readers.
        address: destination of the frames; None: the topic.
        paths: 2: a second copy of each frame is sent, marked for the second path, while there is one. ``SPREAD``: large
            messages are striped over both.

    Attributes:
        second_path_until_s: monotonic second until which there is a second path, as far as known here.
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
        reliable: bool,
        depth: int = 0,
        urgent: bool = False,
        past: SequenceState = FIRST,
        patience: ReaderTimeouts = TOPICS,
        address: Name | None = None,
        paths: int = 1,
    ) -> None:
        self.topic = topic
        self.paths = paths
        self.second_path_until_s = float("-inf")
        self._striper = Striper() if paths == SPREAD else None
        self._is_reliable = reliable
        self.is_urgent = urgent
        self.has_more = False
        self.published: Callable[[Publisher], None] = lambda _: None
        self._keys = KeyEpochs(topic, source, secrets, address)
        self._window = SendWindow(history_depth=depth, first_number=past.next_number, lag_s=patience.lag_s)
        self._queue = SendQueue(
            keys=self._keys, window=self._window, next_number=past.next_number, last_sequence=past.sequence
        )
        self._readers = ReaderProxies(topic, source, patience)
        self._heartbeats = HeartbeatSchedule(description, past.status_number)
        self._acknowledgements = AckNackHandler(
            readers=self._readers, queue=self._queue, window=self._window, heartbeats=self._heartbeats
        )
        self._queue.depth = depth
        self._set_flags()

    @property
    def mtu(self) -> int | None:
        """Return the smallest MTU on the tree, in bytes after the Ethernet header; None until one is installed."""
        return self._queue.mtu

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        return self._queue.drops

    @property
    def bundle_bytes(self) -> int:
        """Return the largest bundle; 0: each message has a seal of its own."""
        return self._queue.bundle_bytes

    @bundle_bytes.setter
    def bundle_bytes(self, size: int) -> None:
        """Set the largest bundle in bytes."""
        self._queue.bundle_bytes = size

    @property
    def readers(self) -> int:
        """Return how many readers have introduced themselves and are alive; none before a tree is installed."""
        return 0 if self.mtu is None else len(self._readers)

    def is_followed_by(self, name: Name, now_s: float, awake_s: float) -> bool:
        """Return whether a tree is installed, and a reader is alive and keeps up.

        Args:
            awake_s: monotonic second since which this participant has received without a stall.
        """
        keeps_up = self._window.has_reader(name) or not self.confirms
        return self.mtu is not None and keeps_up and self._readers.is_alive(name, now_s, awake_s)

    def is_read_by(self, name: Name) -> bool:
        """Return whether a tree is installed, and ``name`` is a reader, keeping up or not."""
        return self.mtu is not None and name in self._readers

    def is_silent(self, name: Name) -> bool:
        """Return whether ``name`` is a reader that has stopped reporting, and may return."""
        return self._readers.is_suspended(name)

    @property
    def is_wanted(self) -> bool:
        """Return whether a message published now is for a reader, or for one that may return to its window."""
        return self.mtu is not None and bool(self._readers or (self.confirms and self._window.suspended))

    @property
    def confirms(self) -> bool:
        """Return whether readers acknowledge messages; those of a best-effort topic do not."""
        return self._queue.is_acknowledged

    @property
    def past(self) -> SequenceState:
        """Return the last numbers, for a later publisher of the same topic."""
        return SequenceState(self._queue.next_number, self._heartbeats.number, self._queue.ledger.last)

    @property
    def messages(self) -> int:
        """Return how many messages were published here, those without any possible reader included."""
        return self._queue.ledger.messages

    @property
    def losses(self) -> Losses:
        """Return which messages some reader did not get, as far as known here, and why."""
        return self._queue.ledger.losses

    @property
    def repairs(self) -> int:
        """Return how many fragments were sent again."""
        return self._window.retransmissions

    def has_space(self) -> bool:
        """Return whether a message may be published without evicting an unacknowledged one."""
        return self._queue.has_space()

    def is_acknowledged(self) -> bool:
        """Return whether every reader has confirmed everything, those that may return included."""
        return self._queue.is_empty and self._window.is_acknowledged()

    @property
    def acknowledged(self) -> int:
        """Return how many messages every reader has confirmed; of a best-effort topic, how many were sent."""
        readers = self._readers.all() if self.confirms else []
        below = min([self._queue.first_waiting, *(each.sequence for each in readers)])
        lost = max((each.lost for each in readers), default=0)
        return min(self._queue.ledger.confirmed(below), max(self.messages - lost, 0))

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Replace the topic's secrets; messages from now on are sealed under the newest epoch.

        A Heartbeat announces the epoch to the readers. For ``EPOCH_GRACE_S`` their reports may still use the epoch
        before.

        Raises:
            LocalError: there is no secret.
        """
        if self._keys.renew(secrets, now_s):
            self._heartbeats.wanted = True
            self.published(self)

    def describe(self, description: bytes) -> None:
        """Change the description from now on; a Heartbeat brings it to present readers at once.

        If the frame of the Heartbeat is lost, the next messages may arrive before it.
        """
        if self._heartbeats.describe(description):
            self.published(self)

    def set_depth(self, depth: int) -> None:
        """Change how many messages are kept for late joiners; 0: none."""
        if depth == self._queue.depth:
            return
        self._queue.set_depth(depth)
        self._set_flags()
        if not self.confirms:
            self._acknowledgements.release_window()
        self._heartbeats.wanted = True
        self.published(self)

    def close(self) -> None:
        """Forget all readers and what waits for them; nothing is sent any more."""
        self._queue.close()
        self._acknowledgements.close()
        self.published(self)  # the last time: the caller that waits for its frames finds none
        self.published = lambda _: None

    def tree_stands(self, mtu: int) -> bool:
        """Note that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header).

        Returns:
            whether something has to be sealed again for it.
        """
        mtu = self._queue.mtu = max(mtu, MTU_MIN_BYTES)
        is_resealed = self._queue.refragment_best_effort(mtu)
        move = self._queue.refragment(mtu)
        if move is not None:
            self._acknowledgements.renumber(move)
        return is_resealed or move is not None

    def publish(self, message: bytes) -> int | None:
        """Queue a message; return the count of published messages, or None when there is no reader.

        The message is confirmed when ``acknowledged`` reaches that count.

        Raises:
            LocalError: above the limits.
        """
        if not self.is_wanted:
            if self._queue.depth:
                self._queue.defer(message)
            else:
                self.drops[DropReason.NO_READER] += 1
                self.skip(LossReason.NO_READER)
            return None
        self._queue.add(message, gather_bytes=WINDOW_BYTES if self._readers else BUNDLE_BYTES)
        self.published(self)
        return self.messages

    def skip(self, reason: LossReason) -> None:
        """Count a message that has no reader: readers find it missing, and a Heartbeat gives the reason."""
        self._queue.skip(reason)
        if self._readers:
            self._heartbeats.wanted = True
            self.published(self)

    def receive_introduction(self, header: Header, frame: bytes) -> None:
        """Process the sealed introduction of a reader, whose reports open from then on; errors are counted."""
        try:
            if header.epoch != self._keys.epoch:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(header.epoch))
            self._readers.introduce(header, frame, self._keys.secret)
        except RemoteError as error:
            self.drops[error.reason] += 1

    def receive_acknack(self, header: Header, frame: bytes, now_s: float) -> bool:
        """Process a reader's sealed report; return whether it is one. Errors are counted."""
        is_old = header.epoch != self._keys.epoch
        try:
            secret = self._keys.secret_of(header.epoch, now_s)
            report, is_new = self._readers.open(header, frame, secret, now_s, may_begin=not is_old)
        except RemoteError as error:
            is_copy = self.paths > 1 and error.reason is DropReason.REPLAYED
            self.drops[DropReason.SECOND_COPY if is_copy else error.reason] += 1
            return False
        if self._striper is not None:
            self._striper.handle_share(header.source, report.share)
        self._acknowledgements.handle_acknack(header.source, report, is_new=is_new, now_s=now_s)
        self._heartbeats.wanted |= is_old  # it has not received the new epoch yet
        return True

    def connect(self, name: Name, incarnation: int, exchange: bytes, now_s: float) -> None:
        """Make a reader active that is known without an introduction; an active one is left unchanged.

        Args:
            exchange: its X25519 key.

        Raises:
            StatementError: MALFORMED, ``exchange`` is no key.
        """
        self._acknowledgements.connect(name, incarnation, exchange, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Suspend silent readers, drop slow ones from the window, and probe those that owe a report."""
        self._acknowledgements.handle_timer(now_s)
        self._heartbeats.wanted |= self._window.probe_due(now_s)
        self._heartbeats.handle_timer(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._window.next_probe(), self._window.next_slow_reader(), self._readers.next_silent()]
        if self._readers and self.mtu is not None:
            times.append(self._heartbeats.get_timer())
        return min((time for time in times if time is not None), default=None)

    def poll_frames(self, now_s: float, limit_bytes: int = _ALL) -> list[bytes]:
        """Return frames that may be sent now, about ``limit_bytes`` at a time; the rest is sealed when it is polled."""
        self.has_more = False
        mtu = self._queue.mtu
        if mtu is None or not self._readers:
            return []
        self._queue.seal_deferred()
        has_pair = self.paths > 1 and now_s < self.second_path_until_s
        limit = max(limit_bytes // (mtu * (2 if has_pair and self._striper is None else 1)), 1)
        frames = self._seal_status(now_s, mtu) if self._heartbeats.is_due(now_s) else []
        heartbeats, repaired = len(frames), self._window.retransmissions
        frames += self._queue.frames_to_send(now_s, limit - len(frames))
        self.has_more = len(frames) >= limit
        if frames:
            self._acknowledgements.last_sent_s = now_s
        if not has_pair:
            return frames
        if self._striper is None:
            return [*frames, *map(second_path_copy, frames)]
        doubled = heartbeats + self._window.retransmissions - repaired
        return self._striper.stripe(frames, doubled, self._readers.names())

    def _set_flags(self) -> None:
        queue = self._queue
        queue.is_acknowledged = self._is_reliable or queue.depth > 0
        wanted = (self._is_reliable, Flag.RELIABLE), (queue.depth, Flag.LATCHED), (self.is_urgent, Flag.URGENT)
        queue.flags = sum(int(flag) for is_set, flag in wanted if is_set)

    def _seal_status(self, now_s: float, mtu: int) -> list[bytes]:
        queue, oldest = self._queue, self._window.oldest
        (sent_number, sent_part), (sent_sequence, oldest_sequence) = queue.sent, queue.sequences
        state = Heartbeat(
            oldest=sent_number if oldest is None else oldest,
            sent_number=sent_number,
            sent_part=sent_part,
            starts={},
            description=b"",
            moves=tuple(queue.moves),
            oldest_sequence=oldest_sequence,
            sent_sequence=sent_sequence,
            gone=tuple(queue.ledger.gone),
        )
        wire = self._heartbeats.poll_heartbeat(state, now_s)
        return list(self._keys.status.seal(self._heartbeats.number, queue.flags, wire, mtu))
