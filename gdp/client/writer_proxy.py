"""Writer proxy: the state that a reader keeps for one publisher of one topic (RTPS 2.5, section 8.4.10).

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A writer proxy begins ``NEW``: it sends introductions until a Heartbeat brings its start and the description. When
``LIVE`` it delivers: a reliable topic in order and complete, a best-effort one in order and as fresh as repairs allow.

It joins seven parts:

- ``gdp/message/reassembly.py``: reassembly of the fragments;
- ``gdp/message/frame_recovery.py``: lost frames from parity;
- ``reordering.py``: messages that wait behind a gap;
- ``delivery.py``: messages in order, and losses;
- ``gdp/message/late_repairs.py``: what is requested again of a best-effort topic, and how long that is awaited;
- ``ack_nack_schedule.py``: when a report is due;
- ``ack_nack_sealer.py``: the keys under which it is sealed.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from enum import Enum
from typing import Final, NamedTuple

from gdp.client.ack_nack_schedule import AckNackSchedule
from gdp.client.ack_nack_sealer import AckNackSealer
from gdp.client.delivery import Delivered, DeliveryQueue
from gdp.client.identities import ReaderIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.reordering import ReorderingBuffer
from gdp.crypto.envelope import Opener
from gdp.crypto.parity_seal import ParityOpener
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import HOPS_AT, NUMBER_AND_PART, NUMBER_AT, SECOND_PATH, Header, decode, second_path_copy
from gdp.frame.kinds import Flag, Kind
from gdp.limits import (
    NACKS_PER_REPORT,
    NUMBER_MAX,
    REPLAY_WINDOW_MESSAGES,
    REPORT_DELAY_S,
    REPORT_IDLE_S,
    SEQUENCE_BYTES,
    SPREAD,
    STRIPES_FROM_PARTS,
)
from gdp.message.acknack import FRAMES_MASK, AckNack, AckNackFlag, MissingRange
from gdp.message.frame_recovery import FrameRecovery
from gdp.message.heartbeat import Heartbeat, StreamStart
from gdp.message.late_repairs import LateRepairs
from gdp.message.loss import Losses, LossReason
from gdp.message.reassembly import ReassembledMessage, Reassembler, VerifiesDigest
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.message.receipts import RECEIPTS_MASK, sum_of_samples
from gdp.message.renumbering import Renumbering
from gdp.message.second_copies import DeferredRequests, SecondCopies
from gdp.message.striping import StripedPaths
from gdp.names import Name
from gdp.sansio import ReceivedFrame
from gdp.trust.advertisement import Advertisement

__all__ = ["Ended", "WriterProxy", "WriterProxyState"]

ANNOUNCE_S: Final = 0.1
_NEVER: Final = float("inf")
_LATCHED: Final = int(Flag.LATCHED)
_WAITING: Final = int(Flag.RELIABLE | Flag.LATCHED)  # topics whose readers wait for what is missing


class WriterProxyState(Enum):
    """State of a writer proxy."""

    NEW = "new"
    LIVE = "live"


class Ended(NamedTuple):
    """Where a writer proxy ended, for a later one of the same publisher: earlier frames are not opened again.

    Args:
        number: of the next message.
        status: number of the newest Heartbeat seen.
        sequence: of the next message.
        known: the first sequence number of unknown fate: messages between the two were published, and did not arrive.
        resumes: the writer proxy ended without its reader's will: what it misses meanwhile is lost, and requested
            again.
    """

    number: int = 0
    status: int = 0
    sequence: int = 0
    known: int = 0
    resumes: bool = False


_NOT_BEGUN: Final = Ended()


class WriterProxy:
    """Reader's state of one incarnation of one publisher of a topic.

    Args:
        writer: the key that must have signed; None: ``secrets`` are of a session, and messages have no signature.
        exchange: the publisher's X25519 key, as its advertisement names it.
        budget: memory of all writer proxies.
        ended: where an earlier writer proxy of the same ended. A latched topic's last messages come again, as its
            publisher announces in a new Heartbeat, unless this writer proxy resumes that one.
        restarted: this reader read another incarnation of the publisher before: what was published in this one is lost.
        waits_since_s: when the topic was subscribed.
        introduces: the publisher gets the reader's key by an introduction, and announces where to begin. Else it knows
            the key already, and the stream is reliable and begins at the first message.

    Attributes:
        advertisement: newest advertisement of the publisher.
        description: the publisher's description of its messages.
        second_path_s: when a frame of the publisher last came by a second path.

    Raises:
        StatementError: MALFORMED, ``exchange`` is no key.
    """

    def __init__(
        self,
        *,
        topic: Name,
        reader: ReaderIdentity,
        publisher: Name,
        incarnation: int,
        writer: VerifiesDigest | None,
        exchange: bytes,
        secrets: Secrets,
        budget: ReassemblyQuota,
        now_s: float,
        ended: Ended = _NOT_BEGUN,
        restarted: bool = False,
        waits_since_s: float | None = None,
        introduces: bool = True,
    ) -> None:
        self.publisher = publisher
        self.incarnation = incarnation
        self.topic = topic
        self.exchange = exchange
        self._reader = reader
        self._secrets = secrets
        self._is_signed = writer is not None
        self._before = ended
        self._is_restarted = restarted
        self._waits_since_s = now_s if waits_since_s is None else waits_since_s
        self._described = 0  # number of the Heartbeat that brought it
        self._openers: dict[tuple[int, int], Opener] = {}
        self._parity_openers: dict[int, ParityOpener] = {}
        self._recovery = FrameRecovery(publisher, budget)
        self._sealer = AckNackSealer(
            topic=topic,
            reader=reader,
            publisher=publisher,
            incarnation=incarnation,
            exchange=exchange,
            secrets=secrets,
            introduces=introduces,
            now_s=now_s,
        )
        self._data = Reassembler(
            publisher, lambda epoch: self._opener(Kind.DATA, epoch), writer, budget, head_bytes=SEQUENCE_BYTES
        )
        self._status = Reassembler(publisher, lambda epoch: self._opener(Kind.HEARTBEAT, epoch), writer, budget)
        self._schedule = AckNackSchedule(self._data, now_s)
        self._order = ReorderingBuffer(publisher, budget)
        self._delivery = DeliveryQueue(publisher, incarnation, self._data.drops)
        self._copies: SecondCopies | StripedPaths | None = None
        self._gap_until_s = float("inf")  # best effort, two paths: until then the slower one may bring what is missing
        self._gap_at = 0  # ... and the number that is missing
        self._held: deque[tuple[float, Heartbeat]] = deque()  # ... and what a Heartbeat says of it counts
        self._deferred = DeferredRequests()
        self._received = 0  # verified DATA frames
        self._receipts = 0  # the sum of the samples among them
        self._newest = (0, -1, now_s)  # the highest of them: number, fragment, and when it came
        self._late = LateRepairs(self._data, self._lag_s, self._recovery.awaited_s)
        self._is_reliable: bool | None = None
        self._sent = (0, 0)  # the publisher has sent everything before this (number, fragment)
        self.state = WriterProxyState.NEW
        self.description = b""
        self.advertisement: Advertisement | None = None
        self.advertisement_sequence = 0
        self.second_path_s = float("-inf")
        if not introduces:
            self._begin_at(max(ended.number, 1), max(ended.sequence, 1), now_s)

    @property
    def idle_s(self) -> float:
        """Return the longest time between two reports."""
        return self._schedule.idle_s

    @idle_s.setter
    def idle_s(self, idle_s: float) -> None:
        """Set the longest time between two reports."""
        self._schedule.idle_s = idle_s

    @property
    def paths(self) -> int:
        """Return over how many paths frames of this publisher come, and reports to it go."""
        if self._copies is None:
            return 1
        return SPREAD if isinstance(self._copies, StripedPaths) else 2

    @paths.setter
    def paths(self, paths: int) -> None:
        """Set over how many paths frames come and reports go."""
        if paths != self.paths:
            self._copies = None
            if paths > 1:
                self._copies = StripedPaths() if paths == SPREAD else SecondCopies()
            self._data.copies, self._status.copies = self._copies, SecondCopies() if paths > 1 else None

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        return self._data.drops + self._status.drops

    @property
    def is_best_effort(self) -> bool:
        """Return whether the publisher has said that it repeats nothing for good."""
        return self._is_reliable is False

    @property
    def delivered(self) -> int:
        """Return how many messages were delivered."""
        return self._delivery.delivered

    @property
    def delivered_bytes(self) -> int:
        """Return the size of what was delivered."""
        return self._delivery.delivered_bytes

    @property
    def recovered(self) -> int:
        """Return how many lost frames parity has restored."""
        return self._recovery.recovered

    @property
    def losses(self) -> Losses:
        """Return which messages are known to be lost, and why."""
        return self._delivery.losses

    @property
    def lost(self) -> int:
        """Return how many messages are known to be lost."""
        return self._delivery.losses.total

    @property
    def ended(self) -> Ended:
        """Return where it ended, for a later one that continues after it."""
        before, delivery = self._before, self._delivery
        status = max(self._status.window.top, before.status)
        if self.state is WriterProxyState.NEW:
            return before._replace(status=status)
        number, known = max(self._order.expected, before.number), max(delivery.known, delivery.sequence)
        return Ended(number, status, delivery.sequence, known)

    def finish(self) -> None:
        """Deliver what is complete, and count what is known to be missing: this incarnation publishes no more."""
        if self.state is WriterProxyState.LIVE:
            delivery = self._delivery
            delivery.skipped = LossReason.PUBLISHER_RESTARTED
            for reassembled in self._order.poll_all():
                delivery.deliver(reassembled)
            delivery.lose_until(delivery.known, LossReason.PUBLISHER_RESTARTED)

    def refuse(self, reason: DropReason) -> None:
        """Count a frame that is dropped unread."""
        self._data.drops[reason] += 1

    def receive(self, header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> None:
        """Process one DATA, HEARTBEAT or PARITY frame of this publisher, which came ``waited_s`` before."""
        if header.incarnation != self.incarnation:
            self._data.drops[DropReason.WRONG_INCARNATION] += 1
            return
        if header.hops_left & SECOND_PATH:
            self.second_path_s = now_s
        if header.kind == Kind.HEARTBEAT and header.number <= self._before.status:
            self._status.drop_copy(header, DropReason.REPLAYED, now_s)
        elif header.kind == Kind.HEARTBEAT:
            reassembled = self._status.add(header, frame, now_s)
            if reassembled is not None:
                self._handle_status(reassembled, header.epoch, now_s)
        elif header.kind == Kind.PARITY:
            self._handle_parity(header, frame, now_s)
        else:
            self._handle_data(header, frame, now_s, now_s - waited_s)

    def receive_run(self, arrivals: Sequence[ReceivedFrame], at: int, now_s: float) -> int:
        """Process the frames of ``arrivals[at:]`` that continue the message under way; return how many."""
        taken = self._data.add_batch(arrivals, at, now_s)
        if taken:
            if isinstance(self._copies, StripedPaths):
                second = sum(each.frame[HOPS_AT] & SECOND_PATH > 0 for each in arrivals[at : at + taken])
                number = int.from_bytes(arrivals[at].frame[NUMBER_AT : NUMBER_AT + 8], "big")
                self._copies.handle_arrivals(number, taken - second, second, now_s)
            self._recovery.keep_run(arrivals, at, taken, now_s)
            self._schedule.count(taken * len(arrivals[at].frame))
            self._received += taken
            self._receipts += sum_of_samples(arrival.frame for arrival in arrivals[at : at + taken])
            number, part = NUMBER_AND_PART.unpack_from(arrivals[at + taken - 1].frame, NUMBER_AT)
            self._note_newest(number, part, now_s - arrivals[at + taken - 1].waited_s)
            if self.state is WriterProxyState.LIVE:
                self._schedule.handle_run(now_s)
        return taken

    def handle_timer(self, now_s: float) -> None:
        """Drop what waited too long for its fragments, and go on without what neither path brought (best effort)."""
        is_final = self.state is WriterProxyState.LIVE and not self._is_reliable
        while self._held and self._held[0][0] <= now_s:
            self._apply_progress(self._held.popleft()[1], now_s)
        is_released = self._late.give_up(now_s)
        if self._gap_until_s <= now_s:
            numbers = self._order.numbers
            if numbers and numbers[0] < self._late.hold(numbers, now_s):
                self._skip_to(numbers[0])
            self._deliver(now_s)
        elif is_released:
            self._deliver(now_s)
        self._data.drop_expired(now_s, for_good=is_final)
        self._status.drop_expired(now_s, for_good=False)
        self._recovery.drop_expired(now_s)

    def get_timer(self) -> float:
        """Return the monotonic second of the next timer."""
        expiries = [self._status.next_expiry(), self._data.next_expiry()]
        held_s = self._held[0][0] if self._held else float("inf")
        due_s = min(self._schedule.due_s, self._gap_until_s, held_s, self._late.get_timer())
        due_s = min(due_s, self._recovery.next_expiry())
        return min([due_s, *(expiry for expiry in expiries if expiry is not None)])

    def is_report_due(self, now_s: float) -> bool:
        """Return whether ``control_to_send`` has a report now."""
        return now_s >= self._schedule.due_s or self._late.is_due(now_s)

    def control_to_send(self, now_s: float) -> list[bytes]:
        """Return the frames of the report that is due, if one is, and of an introduction if it is wanted."""
        schedule = self._schedule
        late = self._late.poll_missing(now_s) if self._late.is_due(now_s) else ()
        if now_s < schedule.due_s and not late:
            return []
        schedule.start_report()
        if self.state is WriterProxyState.NEW:
            schedule.due_s = now_s + ANNOUNCE_S
            number, sequence = (self._before.number, self._before.sequence) if self._before.resumes else (0, 0)
            waited_us = max(round((now_s - self._waits_since_s) * 1e6), 0)
            acknack = AckNack(AckNackFlag.NEW, number, 0, (), sequence, held_us=waited_us)
            return self._over_paths(self._sealer.seal_first(acknack))
        missing, awaited_s = self._missing(now_s) if self._is_reliable else ((), _NEVER)
        if (self._copies is not None or self._data.repeats.copies) and self._is_reliable:
            missing = self._deferred.poll_due(missing, self._lag_s(), now_s)
        schedule.handle_reported(now_s, is_missing=bool(missing))
        schedule.due_s = min(schedule.due_s, self._deferred.due_s, awaited_s)
        expected = self._order.expected
        part, sequence = self._data.progress(expected), self._delivery.sequence
        share = self._copies.poll_share() if isinstance(self._copies, StripedPaths) else 0
        newest, newest_part, came_s = self._newest
        acknack = AckNack(
            AckNackFlag.NONE, expected, part, missing or late, sequence, self.lost, share,
            self._received, newest, max(newest_part, 0), max(round((now_s - came_s) * 1e6), 0),
            (self._data.frames - self._recovery.recovered) & FRAMES_MASK, self._receipts & RECEIPTS_MASK,
        )  # fmt: skip
        return self._over_paths(self._sealer.seal_all(acknack, now_s))

    def poll_delivered(self) -> list[Delivered]:
        """Remove and return the messages that are ready, in order."""
        return self._delivery.poll()

    def close(self) -> list[bytes]:
        """Release all memory; return the frames of the goodbye."""
        self._data.close()
        self._status.close()
        self._recovery.close()
        self._order.poll_all()
        self._late.close()
        self._schedule.due_s = self._gap_until_s = float("inf")
        self._held.clear()
        acknack = AckNack(AckNackFlag.BYE, self._order.expected, 0, (), self._delivery.sequence, self.lost)
        return self._over_paths([self._sealer.seal(acknack)])

    def renew(self, secrets: Secrets) -> None:
        """Replace the topic's secrets; an epoch that is still among them opens as before."""
        self._secrets = secrets
        self._openers.clear()
        self._parity_openers.clear()
        self._sealer.renew(secrets)

    def _note_newest(self, number: int, part: int, came_s: float) -> None:
        """Note a fragment, unless it is a repair: a later one came before."""
        if (number, part) > self._newest[:2]:
            self._newest = number, part, came_s

    def _over_paths(self, notes: list[bytes]) -> list[bytes]:
        """Return notes, and their second copies if there are two paths."""
        return notes if self._copies is None else [*notes, *map(second_path_copy, notes)]

    def _opener(self, kind: Kind, epoch: int) -> Opener:
        opener = self._openers.get((kind, epoch))
        if opener is None:
            secret = self._secrets.get(epoch)
            if secret is None:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(epoch))
            ends = self.publisher, self.incarnation, self.topic
            opener = Opener(secret, kind, *ends, is_signed=self._is_signed)
            self._openers[kind, epoch] = opener
        return opener

    def _handle_parity(self, header: Header, frame: bytes, now_s: float) -> None:
        """Restore what is lost, as far as parity suffices; it arrives now, and counts as lost on the way."""
        try:
            if self._data.window.is_finished(header.number):
                raise EnvelopeError(DropReason.UNUSED_PARITY, "its message is complete")
            opener = self._parity_openers.get(header.epoch)
            if opener is None:
                secret = self._secrets.get(header.epoch)
                if secret is None:
                    raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(header.epoch))
                opener = ParityOpener(secret, self.publisher, self.incarnation, self.topic)
                self._parity_openers[header.epoch] = opener
            restored = self._recovery.add_parity(header, opener.open(header, frame), now_s)
        except EnvelopeError as error:
            self._data.drops[error.reason] += 1
            return
        for each in restored:
            self._handle_data(decode(each), each, now_s, now_s, is_restored=True)

    def _handle_data(
        self, header: Header, frame: bytes, now_s: float, came_s: float, *, is_restored: bool = False
    ) -> None:
        reassembler, expected = self._data, self._order.expected
        if header.number > NUMBER_MAX:
            reassembler.drops[DropReason.MALFORMED] += 1
            return
        if self.state is WriterProxyState.LIVE and not 0 <= header.number - expected < REPLAY_WINDOW_MESSAGES:
            if header.number < expected:
                reassembler.drop_copy(header, DropReason.LATE, now_s)
            else:
                reassembler.drops[DropReason.MEMORY_FULL] += 1
            return
        striped = self._copies if isinstance(self._copies, StripedPaths) else None
        is_done = reassembler.window.is_finished(header.number)
        seen, highest, refused = reassembler.new_parts, reassembler.highest, reassembler.drops[DropReason.MEMORY_FULL]
        reassembled = reassembler.add(header, frame, now_s)
        is_first = reassembler.new_parts > seen
        if striped is not None and header.parts >= STRIPES_FROM_PARTS and not is_done and (is_first or not header.part):
            second = int(header.hops_left & SECOND_PATH > 0)
            striped.handle_arrivals(header.number, 1 - second, second, now_s)
        if is_first:
            if self._is_reliable is None:
                self._set_reliable(header.flags)
            self._schedule.count(header.length)
            if is_restored:
                self._recovery.recovered += 1
            else:
                self._received += 1
                self._receipts += sum_of_samples((frame,))
            if reassembled is None:
                self._recovery.keep(header, frame, now_s)
            self._note_newest(header.number, header.part, came_s)
            if self.state is WriterProxyState.LIVE:
                self._schedule.handle_part(header, highest, expected, now_s)
                if reassembled is None and not self._is_reliable:
                    self._late.handle_part(header, now_s)
        if reassembled is not None:
            self._recovery.forget(header.number)
            if self.state is WriterProxyState.LIVE and not self._is_reliable:
                self._late.handle_complete(reassembled.number, header.part, now_s)
            if striped is not None:
                striped.handle_complete(reassembled.number)
                if striped.has_news:
                    self._schedule.due_s = min(self._schedule.due_s, now_s + REPORT_DELAY_S)
            self._sealer.handle_message(reassembled.number, header.epoch, now_s)
            self._arrange(reassembled, now_s)
        elif (
            reassembler.drops[DropReason.MEMORY_FULL] > refused and self.state is WriterProxyState.LIVE and self._order
        ):
            self._delivery.skipped = LossReason.READER_MEMORY
            # the memory behind the gap is exhausted: go on without the missing messages
            self._skip_to(self._order.numbers[0])
            self._deliver(now_s)

    def _arrange(self, reassembled: ReassembledMessage, now_s: float) -> None:
        """Order a complete message, and deliver the consecutive ones."""
        order, delivery = self._order, self._delivery
        skips = not self._is_reliable and self._lag_s() <= 0 and reassembled.number < self._late.hold((), now_s)
        if self.state is WriterProxyState.LIVE and (skips or reassembled.number == order.expected):
            if reassembled.number > order.expected:
                self._skip_to(reassembled.number)
            delivery.deliver(reassembled)
            order.expected = reassembled.number + 1
            self._deliver(now_s)
        elif order.put(reassembled):
            delivery.record_published(min(int.from_bytes(reassembled.head, "big"), NUMBER_MAX) + 1)
            if not self._is_reliable:
                self._deliver(now_s)
        elif self.state is WriterProxyState.NEW:
            self._data.drops[DropReason.MEMORY_FULL] += 1
        else:
            delivery.skipped = LossReason.READER_MEMORY
            self._skip_to(reassembled.number)
            delivery.deliver(reassembled)
            order.expected += 1
            self._deliver(now_s)

    def _missing(self, now_s: float) -> tuple[tuple[MissingRange, ...], float]:
        """Return what is known to be missing, and the first second at which parity may no longer fill what else is.

        That is gaps below the newest fragment, and all that a Heartbeat announced.
        """
        missing: list[MissingRange] = []
        due_s = _NEVER
        sent_number, sent_part = self._sent
        end = max(self._data.highest + 1, sent_number + (sent_part > 0))
        for number in self._data.window.unfinished(self._order.expected, end):
            capacity = NACKS_PER_REPORT - len(missing)
            if capacity <= 0:
                break
            awaited_s = self._recovery.awaited_s(number, now_s)
            if awaited_s > now_s:
                due_s = min(due_s, awaited_s)
                continue
            ranges = self._data.missing(number, capacity, to_end=number < sent_number)
            if not ranges and number == sent_number:
                ranges = _below(self._data.missing(number, capacity, to_end=True), sent_part)
            missing += [MissingRange(number, *each) for each in ranges]
        return tuple(missing), due_s

    def _handle_status(self, reassembled: ReassembledMessage, epoch: int, now_s: float) -> None:
        try:
            status = Heartbeat.from_wire(reassembled.message)
        except RemoteError as error:
            self._status.drops[error.reason] += 1
            return
        self._set_reliable(reassembled.flags)
        is_newest = reassembled.number == self._status.window.top
        self._sealer.handle_status(epoch, now_s, is_newest=is_newest)
        if self.state is WriterProxyState.NEW:
            start = status.starts.get(self._reader.name)
            if start is None or start.incarnation != self._reader.incarnation:
                return
            self._begin(status, start, is_latched=bool(reassembled.flags & _LATCHED))
        if status.description and reassembled.number > self._described:
            self.description, self._described = status.description, reassembled.number
        order, delivery = self._order, self._delivery
        if is_newest:
            delivery.gone = status.gone
        self._sent = max(self._sent, (status.sent_number, status.sent_part))
        for move in status.moves:
            if move.is_before(order.expected):
                self._renumber(move)
        lag_s = max(self._lag_s(), self._late.wait_s(status.oldest, now_s))
        if self._is_reliable or lag_s <= 0:
            self._apply_progress(status, now_s)
        else:
            self._held.append((now_s + lag_s, status))
        self._schedule.due_s = now_s

    def _apply_progress(self, status: Heartbeat, now_s: float) -> None:
        """Go on where a Heartbeat says that nothing before will come, and count that as lost."""
        order, delivery = self._order, self._delivery
        otherwise = delivery.gap_reason
        if status.oldest > order.expected:
            self._skip_to(status.oldest)
            delivery.lose_until(status.oldest_sequence, otherwise)
        self._deliver(now_s)
        if order.expected == status.sent_number:
            delivery.lose_until(status.sent_sequence, otherwise)
        delivery.record_published(status.sent_sequence)

    def _begin(self, status: Heartbeat, start: StreamStart, *, is_latched: bool) -> None:
        """Begin at the publisher's start, and count what came between that and the last message read before."""
        before, delivery = self._before, self._delivery
        expected = start.number
        if before.resumes or not is_latched:
            expected = max(start.number, before.number)
        begun, why = start.confirmed, LossReason.READER_RESTARTED
        if before.resumes and before.sequence:
            begun, why = before.sequence, LossReason.DETACHED
        elif self._is_restarted:
            begun, why = 1, LossReason.PUBLISHER_RESTARTED
        delivery.gone = status.gone if why is LossReason.DETACHED else ()
        delivery.sequence = begun or start.sequence
        delivery.lose_until(start.sequence, why)
        delivery.gone = status.gone
        delivery.sequence = max(start.sequence, before.sequence) if expected > start.number else start.sequence
        self.state = WriterProxyState.LIVE
        self._order.start_at(expected)
        self._data.start_at(expected, self._order.numbers)

    def _begin_at(self, number: int, sequence: int, now_s: float) -> None:
        """Begin a reliable stream at a message, without a Heartbeat."""
        self.state = WriterProxyState.LIVE
        self._is_reliable = self._delivery.is_reliable = True
        self._order.expected, self._delivery.sequence = number, sequence
        self._data.start_at(number, ())
        self._schedule.due_s = now_s + REPORT_IDLE_S

    def _set_reliable(self, flags: int) -> None:
        self._is_reliable = self._delivery.is_reliable = bool(flags & _WAITING)
        if self._is_reliable:
            self._late.close()

    def _renumber(self, move: Renumbering) -> None:
        """Apply a renumbering, also to the messages that wait."""
        if self._order.expected < move.first:
            self._skip_to(move.first)
        moved = self._order.renumber(move)
        self._data.forget(self._order.expected)
        for reassembled in moved:
            if reassembled.number not in self._order and self._order.put(reassembled):
                self._data.skip(reassembled.number)

    def _skip_to(self, number: int) -> None:
        """Accept that missing messages before ``number`` will not come."""
        for reassembled in self._order.skip_to(number):
            self._delivery.deliver(reassembled)
        self._data.forget(number)
        self._late.forget(number)
        self._recovery.forget_below(number)

    def _deliver(self, now_s: float) -> None:
        order = self._order
        gap_until_s, self._gap_until_s = self._gap_until_s, float("inf")
        if self.state is WriterProxyState.NEW or not order:
            return
        for reassembled in order.consecutive():
            self._delivery.deliver(reassembled)
        if not order or self._is_reliable:
            return
        lag_s, free_to = self._lag_s(), self._late.hold(order.numbers, now_s)
        if lag_s > 0:
            is_same = self._gap_at == order.expected and now_s < gap_until_s < float("inf")
            self._gap_at, self._gap_until_s = order.expected, gap_until_s if is_same else now_s + lag_s
        elif free := [number for number in order.numbers if number < free_to]:
            self._skip_to(free[-1] + 1)

    def _lag_s(self) -> float:
        """Return how long a copy may take to bring what the faster path, or the first frame, did not; 0: none comes."""
        return self._data.repeats.lag_s() if self._copies is None else self._copies.lag_s()


def _below(ranges: list[tuple[int, int]], end: int) -> list[tuple[int, int]]:
    """Return the parts of inclusive ranges that lie below ``end``."""
    return [(first, min(last, end - 1)) for first, last in ranges if first < end]
