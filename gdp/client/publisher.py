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
from gdp.client.best_effort_cache import BestEffortCache
from gdp.client.blocking_readers import BlockingReaders, PathState
from gdp.client.heartbeat_schedule import HeartbeatSchedule
from gdp.client.identities import WriterIdentity
from gdp.client.key_epochs import KeyEpochs, Secrets
from gdp.client.parity_sender import RTT_MIN_S, ParitySender
from gdp.client.reader_path import ReaderPath, ReaderPaths
from gdp.client.reader_proxies import TOPICS, ReaderProxies, ReaderTimeouts
from gdp.client.redundancy import Redundancy
from gdp.client.send_options import DEFAULT_OPTIONS, SendOptions
from gdp.client.send_queue import SendQueue
from gdp.client.sent_frames import SentFrames
from gdp.client.sequence_numbers import FIRST, SequenceState
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import NUMBER_AND_PART, NUMBER_AT, SECOND_PATH, Header, second_path_copy
from gdp.frame.kinds import Flag
from gdp.limits import MTU_MIN_BYTES, SPREAD, WINDOW_BYTES
from gdp.message.bundle import BUNDLE_BYTES
from gdp.message.frame_loss import Readers
from gdp.message.heartbeat import Heartbeat
from gdp.message.loss import Losses, LossReason
from gdp.message.send_window import SendWindow
from gdp.message.striping import Striper
from gdp.names import Name
from gdp.token_bucket import TokenBucket

__all__ = ["Publisher"]

_ALL: Final = 1 << 30
_NEVER: Final = float("inf")
_AWAITED_MAX: Final = 64  # messages kept for readers that waited; as many as a latched topic of ROS keeps here
_ALONE_FROM_S: Final = 1.0  # after a second path: round trips enough to measure the one that remains
_LIMIT_BURST_S: Final = 0.05  # of ``max_bits_s``: a burst of this time leaves at once


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
        reader_paths: what may leave to each reader node; shared by all publishers of a participant.
        options: how fresh, how much and how often its messages leave.
        fastest_governs: the first answer to a message counts, so readers on slower paths do not hold it back.

    Attributes:
        options: as set last.
        path_share: of what the path carries, 0 to 1; the other topics that wait have the rest.
        redundancy: copies of its frames against loss.
        parity: parity frames of its large messages.
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
        reader_paths: ReaderPaths | None = None,
        options: SendOptions = DEFAULT_OPTIONS,
        fastest_governs: bool = False,
    ) -> None:
        self.topic = topic
        self._fastest_governs = fastest_governs
        self.paths = paths
        self.options = options
        self._reader_paths = ReaderPaths() if reader_paths is None else reader_paths
        self.path_share = 1.0
        self._blocking = BlockingReaders(patience.lag_s)
        self._seen_s = 0.0
        self._awaits_until_s = _NEVER
        self._under_way = SentFrames(self._reader_paths, counts_losses=paths != SPREAD)
        self._uncounted: tuple[list[bytes], list[bytes], float, int] | None = None
        self._limit = _limit_of(options)
        self.second_path_until_s = float("-inf")
        self._striper = Striper() if paths == SPREAD else None
        self._is_reliable = reliable
        self.is_urgent = urgent
        self.has_more = False
        self.published: Callable[[Publisher], None] = lambda _: None
        self._keys = KeyEpochs(topic, source, secrets, address)
        self._window = SendWindow(history_depth=depth, first_number=past.next_number, lag_s=patience.lag_s)
        self._queue = SendQueue(
            keys=self._keys, window=self._window, next_number=past.next_number, last_sequence=past.sequence,
            options=options,
        )  # fmt: skip
        self._late = BestEffortCache(options)
        self._readers = ReaderProxies(topic, source, patience)
        self._heartbeats = HeartbeatSchedule(description, past.status_number)
        self._acknowledgements = AckNackHandler(
            readers=self._readers, queue=self._queue, window=self._window, heartbeats=self._heartbeats
        )
        self.redundancy = Redundancy(budget=source.copies, path=self, is_enabled=urgent and options.fec)
        self.parity = ParitySender(keys=self._keys, budget=source.parity, is_enabled=paths == 1 and options.fec)
        self._loss: float | None = None  # of frames, where parity may save time
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

    def reader_names(self) -> list[Name]:
        """Return the readers that have introduced themselves and have not left, silent ones included."""
        return [Name(each) for each in self._readers.names()]

    def active_readers(self, now_s: float) -> list[bytes]:
        """Return the readers that report; those that have missed reports come last."""
        readers = self._readers
        return [] if self.mtu is None else sorted(readers, key=lambda name: readers.is_quiet(name, now_s))

    def is_sent(self, sequence: int) -> bool:
        """Return whether all frames of a message are sent."""
        return self._queue.sequences[0] > sequence

    def cancel(self, sequence: int) -> None:
        """Send nothing more of a message, and repair nothing; bundled ones are small, and leave."""
        number = self._queue.ledger.number_of(sequence)
        if number is not None and self._window.cancel(number):
            self.parity.cancel(number)
            self._acknowledgements.lose_ended([number])
            self.published(self)

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
        return self._window.retransmissions + self._late.retransmissions

    def is_limited(self, now_s: float) -> bool:
        """Return whether messages wait now because ``max_bits_s`` lets no frame leave."""
        return self._limit is not None and not self._queue.is_empty and self._limit.left(now_s) <= 0

    @property
    def epoch(self) -> int:
        """Return the key epoch that seals."""
        return self._keys.epoch

    def has_space(self) -> bool:
        """Return whether a message may be published without evicting an unacknowledged one."""
        return self._queue.has_space()

    def is_acknowledged(self) -> bool:
        """Return whether every reader has confirmed everything, those that may return included."""
        return self._queue.is_empty and self._window.is_acknowledged()

    @property
    def acknowledged(self) -> int:
        """Return how many messages every reader has confirmed; of a best-effort topic, how many were sent."""
        if not self.confirms:
            return self.sent
        readers = self._readers.all()
        below = min([self._queue.first_waiting, *(each.sequence for each in readers)])
        lost = max((each.lost for each in readers), default=0)
        return min(self._queue.ledger.confirmed(below), max(self.messages - lost, 0))

    @property
    def sent(self) -> int:
        """Return how many messages have left, not counting those that some reader is known not to get."""
        return self._queue.ledger.confirmed(self._queue.sequences[0])

    @property
    def reader_lost(self) -> int:
        """Return how many messages the reader that lost most reports as lost, those that never left included."""
        return max((each.lost for each in self._readers.all()), default=0)

    def is_reported(self) -> bool:
        """Return whether nothing waits, and every reader has reported each message as delivered or lost."""
        return self._queue.is_empty and all(each.sequence > self._queue.ledger.last for each in self._readers.all())

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Replace the topic's secrets; messages from now on are sealed under the newest epoch.

        A Heartbeat announces the epoch to the readers. For ``EPOCH_GRACE_S`` their reports may still use the epoch
        before. Messages for late joiners, who may lack that epoch, are sealed again.

        Raises:
            LocalError: there is no secret.
        """
        if self._keys.renew(secrets, now_s):
            self._heartbeats.wanted = True
            mtu = self._queue.mtu
            move = self._queue.refragment(mtu, is_forced=True) if self._queue.depth and mtu is not None else None
            if move is not None:
                self._acknowledgements.renumber(move)
            self.published(self)

    def describe(self, description: bytes) -> None:
        """Change the description from now on; a Heartbeat brings it to present readers at once.

        If the frame of the Heartbeat is lost, the next messages may arrive before it.
        """
        if self._heartbeats.describe(description):
            self.published(self)

    def set_options(self, options: SendOptions) -> None:
        """Change how fresh, how much and how often messages leave, those that wait included."""
        if options.max_bits_s != self.options.max_bits_s:
            self._limit = _limit_of(options)
        self.options = options
        self._queue.set_options(options)
        self.redundancy.is_enabled = self.is_urgent and options.fec
        self.parity.is_enabled = self.paths == 1 and options.fec
        self._measure_loss(self._seen_s)
        self._late.set_options(options)

    def await_readers(self, until_s: float) -> None:
        """Keep messages until a second for readers that waited before they were published.

        A reader waits as long as its subscription exists; the path to it comes later than the first messages.
        """
        if self.confirms:
            self._awaits_until_s = until_s
            self._queue.await_readers(_AWAITED_MAX)
            self.published(self)

    @property
    def is_awaiting(self) -> bool:
        """Return whether messages are kept for readers that waited, and may still come."""
        return self._queue.awaited > 0

    @property
    def keeps_unread(self) -> bool:
        """Return whether a message without a reader is kept."""
        return self._queue.kept > 0

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

    def allowance(self, now_s: float) -> int:
        """Return how many bytes of frames may leave now, as far as the paths to its readers permit; 0: none.

        Of a topic that sends each frame over two paths, the round trip changes with the path whose copy comes first. So
        no path governs it while there are two. When one ends, the other has carried every frame, but is not measured:
        the first window would delay messages that fit it. It governs a second later.
        """
        if self._limit is not None and self._limit.left(now_s) <= 0:
            return 0
        self._seen_s, urgent = now_s, self.is_urgent
        if self._is_doubled(now_s - _ALONE_FROM_S):
            return _ALL
        paths = self._paths()
        if len(paths) == 1 and not self._blocking:
            return paths[0].allowance(now_s, urgent=urgent)
        allowances = [path.allowance(now_s, urgent=urgent) for path in paths]
        if self._fastest_governs:
            return max(allowances, default=_ALL)
        if self._blocking or (len(allowances) > 1 and min(allowances) <= 0):
            self._record_blocks(now_s)
        return min(allowances, default=_ALL)

    def next_send_s(self, now_s: float) -> float | None:
        """Return when ``allowance`` may be more than 0; None: not before a reader confirms something."""
        governs = min if self._fastest_governs else max
        due_s = governs((path.next_send_s() for path in self._paths()), default=now_s)
        if self._limit is not None and (left := self._limit.left(now_s)) <= 0:
            due_s = max(due_s, now_s + self._limit.seconds_for(1 - left))
        return None if due_s == _NEVER else due_s

    def awaited_readers(self) -> frozenset[bytes]:
        """Return the readers whose paths must all permit a frame at once; empty: there is one path."""
        names = self._governing_names()
        return frozenset(names) if len(names) > 1 and not self._fastest_governs else frozenset()

    def has_any(self, readers: frozenset[bytes]) -> bool:
        """Return whether one of these nodes is a reader."""
        return any(name in self._readers for name in readers)

    def note_idle(self) -> None:
        """Note that nothing waits, though the paths may permit more."""
        for path in self._paths():
            path.note_idle()

    @property
    def path_bytes_s(self) -> float | None:
        """Return the bytes a second that this topic may expect of its path; None: not measured, and no limit."""
        rate = min((rate for path in self._measured_paths() if (rate := path.controller.bytes_s)), default=0.0)
        shares = [rate * self.path_share] if rate else []
        if self.options.max_bits_s is not None:
            shares.append(self.options.max_bits_s / 8)
        return min(shares, default=None)

    @property
    def capacity_bytes_s(self) -> float | None:
        """Return how many bytes a second the narrowest path carries; None: not measured."""
        rates = (path.controller.capacity_bytes_s for path in self._measured_paths())
        return min((rate for rate in rates if rate), default=None)

    @property
    def path_loss(self) -> float:
        """Return the share of frames that were lost lately on the worst path, 0 to 1."""
        return max((path.controller.loss for path in self._measured_paths()), default=0.0)

    @property
    def path_rtt_s(self) -> float | None:
        """Return the smoothed round trip of the longest path in seconds; None: not measured."""
        trips = (path.controller.rtt_s for path in self._measured_paths())
        return max((trip for trip in trips if trip is not None), default=None)

    def close(self) -> None:
        """Forget all readers and what waits for them; nothing is sent any more."""
        self._under_way.keep(())
        self._queue.close()
        self._late.close()
        self._acknowledgements.close()
        self.published(self)  # the last time: the caller that waits for its frames finds none
        self.published = lambda _: None

    def tree_stands(self, mtu: int) -> bool:
        """Note that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header).

        Returns:
            whether something has to be sealed again for it.
        """
        mtu = self._queue.mtu = max(mtu, MTU_MIN_BYTES)
        self._reader_paths.set_mtu(self._readers, mtu)
        self._late.drop_larger(mtu)
        is_resealed = self._queue.refragment_best_effort(mtu)
        move = self._queue.refragment(mtu)
        if move is not None:
            self._acknowledgements.renumber(move)
        return is_resealed or move is not None

    def publish(self, message: bytes, now_s: float | None = None) -> int | None:
        """Queue a message; return the count of published messages, or None when there is no reader.

        The message is confirmed when ``acknowledged`` reaches that count.

        Args:
            now_s: from when it ages, on a best-effort topic; None: from when frames are polled next.

        Raises:
            LocalError: above the limits.
        """
        if not self.is_wanted:
            if self._queue.kept:
                self._queue.defer(message, now_s)
            else:
                self.drops[DropReason.NO_READER] += 1
                self.skip(LossReason.NO_READER, now_s)
            return None
        self._queue.add(message, gather_bytes=WINDOW_BYTES if self._readers else BUNDLE_BYTES, added_s=now_s)
        self.published(self)
        return self.messages

    def skip(self, reason: LossReason, now_s: float | None = None) -> None:
        """Count a message that has no reader: readers find it missing, and a Heartbeat gives the reason."""
        self._queue.skip(reason, now_s)
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

    def receive_acknack(self, header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> bool:
        """Process a reader's sealed report, which came ``waited_s`` before; return whether it is one.

        Errors are counted.
        """
        self.count_sent()
        self._queue.drop_aged(now_s)
        is_old = header.epoch != self._keys.epoch
        try:
            secret = self._keys.secret_of(header.epoch, now_s)
            report, is_new = self._readers.open(header, frame, secret, now_s, may_begin=not is_old)
        except RemoteError as error:
            is_copy = self.paths > 1 and error.reason is DropReason.REPLAYED
            self.drops[DropReason.SECOND_COPY if is_copy else error.reason] += 1
            return False
        self._reader_paths.note_incarnation(header.source, self._readers[header.source].incarnation_id.started, now_s)
        if self._striper is not None:
            self._striper.handle_share(header.source, report.share)
        if not header.hops_left & SECOND_PATH:
            self._under_way.handle_hops(header.source, header.hops_left, now_s)
        if self._under_way.handle_report(header.source, report, now_s, waited_s):
            self.drops[DropReason.UNPROVEN] += 1
        self.redundancy.handle_report(header.source, report, is_new=is_new)
        self.parity.handle_report({each.number for each in report.missing})
        self._measure_loss(now_s)
        if self._fastest_governs:
            self._window.governing = next(iter(self._fastest_names()), None)
        path = self._reader_paths.get(header.source)
        trip_s = 0.0 if path is None else path.trip_s
        self._acknowledgements.handle_acknack(header.source, report, is_new=is_new, now_s=now_s, trip_s=trip_s)
        if report.missing and not self.confirms:
            newest = report.newest, report.newest_part
            self._late.request(header.source, report.missing, now_s, newest=newest, rtt_s=self.path_rtt_s)
        self._heartbeats.is_reminder_wanted |= is_old  # it has not received the new epoch yet
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
        for name in self._blocking.slow(now_s):
            self._acknowledgements.exclude(name, now_s)
        self._late.drop_expired(now_s)
        if now_s >= self._awaits_until_s:
            self._awaits_until_s = _NEVER
            self._queue.await_readers(0)
        self._heartbeats.wanted |= self._window.probe_due(now_s)
        self._heartbeats.handle_timer(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._window.next_probe(), self._window.next_slow_reader(), self._readers.next_silent()]
        times += [self._late.get_timer(), self._blocking.get_timer()]
        times += [self._awaits_until_s] if self._awaits_until_s < _NEVER else []
        if self._readers and self.mtu is not None:
            times += [self._heartbeats.get_timer(), self.redundancy.get_timer()]
        return min((time for time in times if time is not None), default=None)

    def poll_frames(self, now_s: float, limit_bytes: int = _ALL) -> list[bytes]:
        """Return about ``limit_bytes`` of frames; the rest is sealed when it is polled.

        Heartbeats that are due leave in any case; with ``limit_bytes`` 0 nothing else does. ``count_sent`` follows,
        before another publisher asks what the same paths permit.
        """
        self.count_sent()
        self.has_more = False
        mtu = self._queue.mtu
        if mtu is None or not self._readers:
            self.redundancy.clear()
            self.parity.clear()
            if not self._readers:
                self._queue.drop_unread()
            return []
        self._queue.drop_aged(now_s)
        self._queue.seal_deferred()
        if not self.confirms:
            self._queue.bytes_s = self.path_bytes_s
            self._heartbeats.is_reminder_wanted |= self._queue.drop_expired(now_s)
        has_pair = self.paths > 1 and now_s < self.second_path_until_s
        status = self._seal_status(now_s, mtu) if self._heartbeats.is_due(now_s) else []
        heartbeats, repaired = len(status), self.repairs
        sent, parity, parity_after = list[bytes](), list[bytes](), list[bytes]()
        if limit_bytes > 0:
            limit = max(limit_bytes // (mtu * (2 if has_pair and self._striper is None else 1)), 1)
            parity = self.parity.poll_frames(limit)
            sent = self._frames_to_send(now_s, limit - len(parity)) if len(parity) < limit else []
            late = self._late_repairs(now_s, limit - len(parity) - len(sent))
            sent = late + sent  # those that were sent before come first in the account
            if self._loss is not None:
                self.parity.handle_sent(sent, self._loss, self.capacity_bytes_s, now_s)
            left = limit - len(parity) - len(sent)
            self.has_more = left <= len(self.parity)
            parity_after = self.parity.poll_frames(max(left, 0))
            if not self._is_doubled(now_s):
                again = self.repairs - repaired
                self._uncounted = sent, self._confirming(sent, again), now_s, again
            if self._limit is not None and (leaving := sum(map(len, parity + sent + parity_after))):
                self._limit.charge(now_s, leaving)
        frames = status + parity + sent + parity_after
        if frames:
            self._acknowledgements.last_sent_s = now_s
        self.redundancy.handle_sent(sent, self._measured_readers(), now_s, has_pair=has_pair)
        copies = self.redundancy.poll_copies(now_s)
        if extra := copies + parity + parity_after:
            for path in self._paths():
                path.controller.charge(sum(map(len, extra)), now_s)
        frames += copies
        if not has_pair:
            return frames
        if self._striper is None:
            return [*frames, *map(second_path_copy, frames)]
        doubled = heartbeats + self.repairs - repaired
        return self._striper.stripe(frames, doubled, self._readers.names())

    def count_sent(self) -> None:
        """Count the frames polled last on the paths to the readers."""
        uncounted, self._uncounted = self._uncounted, None
        if uncounted is not None:
            frames, readers, polled_s, again = uncounted
            self._under_way.sent(frames, readers, polled_s, again)

    def _frames_to_send(self, now_s: float, limit: int) -> list[bytes]:
        """Return at most ``limit`` frames: late repairs first."""
        repairs = self._late.frames_to_send(now_s, limit)
        new = self._queue.frames_to_send(now_s, limit - len(repairs)) if len(repairs) < limit else []
        if not self.confirms:
            self._late.record_sent(new, now_s)
        return repairs + new

    def _late_repairs(self, now_s: float, limit: int) -> list[bytes]:
        """Return at most ``limit`` frames that slower readers lack, as far as the paths to all permit."""
        if limit <= 0 or self._window.governing is None:
            return []
        allowance = min((path.allowance(now_s) for path in self._paths()), default=0)
        return self._window.late_repairs_to_send(now_s, min(limit, -(-allowance // (self.mtu or MTU_MIN_BYTES))))

    def _is_doubled(self, now_s: float) -> bool:
        """Return whether each frame travels over two paths now."""
        return self.paths > 1 and self._striper is None and now_s < self.second_path_until_s

    def _record_blocks(self, now_s: float) -> None:
        """Note which readers hold back the others."""
        paths = [(name, self._reader_paths.path(name, now_s)) for name in self._governing_names()]
        states = [PathState(name, path.allowance(now_s), path.sent_bytes) for name, path in paths if not path.is_silent]
        self._blocking.record(states, now_s)

    def _measure_loss(self, now_s: float) -> None:
        """Note whether messages get parity from now on; reports change that, not each poll.

        The round trip of the empty path counts, because a busy machine lengthens the others on any link.
        """
        controllers = [path.controller for path in self._measured_paths()] if self.parity.is_enabled else []
        trip_s = max((each.base_rtt_s for each in controllers if each.rtt_s is not None), default=None)
        is_long = trip_s is not None and trip_s >= RTT_MIN_S
        self._loss = self.redundancy.loss(self._measured_readers(), now_s) if is_long else None
        self._queue.has_parity = self.parity.is_wanted(self._loss, trip_s, self.options.deadline_s)

    def _paths(self) -> list[ReaderPath]:
        """Return the paths to the readers that may govern, the slowest of which does; of requests the fastest does."""
        return self._reader_paths.governing(self._governing_names(), self._seen_s)

    def governing_reader(self) -> tuple[Name, float, float] | None:
        """Return the slowest of several readers, its round trip in seconds, and its bytes a second, or None."""
        names = self._governing_names()
        paths = {name: path for name in names if (path := self._reader_paths.get(name)) is not None and path.trip_s}
        if len(names) < 2 or not paths or self._fastest_governs:
            return None
        name = min(paths, key=lambda each: paths[each].allowed_bytes_s)
        return Name(name), paths[name].trip_s, paths[name].allowed_bytes_s

    def _measured_readers(self) -> Readers:
        """Return the readers whose losses copies and parity are for: where the fastest governs, its own alone."""
        return self._fastest_names() if self._fastest_governs else self._readers

    def _measured_paths(self) -> list[ReaderPath]:
        names = self._fastest_names() if self._fastest_governs else self._governing_names()
        return self._reader_paths.governing(names, self._seen_s)

    def _fastest_names(self) -> list[bytes]:
        return self._reader_paths.fastest(self._governing_names(), self._seen_s)

    def _governing_names(self) -> list[bytes]:
        """Return the readers that keep up: the others must not wait for one that does not. Without any, return all.

        A best-effort reader whose program is slow drops frames itself, which costs no other. One behind a thin link
        keeps up as long as that link carries something, because frames beyond its rate would harm all who share it.
        """
        names, paths, now_s = self._present_readers(), self._reader_paths, self._seen_s
        if self.confirms:
            window, following = self._window, self._queue.sent[0]
            keeping_up = [each for each in names if window.has_reader(each)]
            return [each for each in keeping_up if not window.is_ahead(each, following)] or keeping_up or names
        readers = self._readers
        return [each for each in names if now_s >= readers[each].out_until_s and not paths.is_behind(each)] or names

    def _confirming(self, frames: list[bytes], again: int) -> list[bytes]:
        """Return the readers that confirm these frames, the first ``again`` of which are repairs.

        One that began with a later message than the last of them does not.
        """
        names, window = self._present_readers(), self._window
        if len(frames) <= again or len(names) < 2 or not self.confirms:
            return names
        number, _ = NUMBER_AND_PART.unpack_from(frames[-1], NUMBER_AT)
        return [name for name in names if not window.is_ahead(name, number)]

    def _present_readers(self) -> list[bytes]:
        """Return the readers whose nodes have not started again since they began to read. Without any, return all."""
        readers, is_former = self._readers, self._reader_paths.is_former
        names = [name for name in readers if not is_former(name, readers[name].incarnation_id.started)]
        return names or list(readers)

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
        trip_s = max((path.patience_s(now_s) for path in self._paths()), default=0.0)
        wire = self._heartbeats.poll_heartbeat(state, now_s, trip_s)
        return list(self._keys.status.seal(self._heartbeats.number, queue.flags, wire, mtu))


def _limit_of(options: SendOptions) -> TokenBucket | None:
    """Return the bucket of bytes of ``max_bits_s``."""
    if options.max_bits_s is None:
        return None
    bytes_s = options.max_bits_s / 8
    return TokenBucket(bytes_s, max(bytes_s * _LIMIT_BURST_S, 1.0))
