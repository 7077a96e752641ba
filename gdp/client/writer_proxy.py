"""Writer proxy: the state that a reader keeps for one publisher of one topic (RTPS 2.5, section 8.4.10).

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A writer proxy begins ``NEW``: it sends introductions until a Heartbeat brings its start and the description. When
``LIVE`` it delivers: a reliable topic in order and complete, a best-effort one in order and as fresh as repairs allow.

It joins six parts:

- ``gdp/message/reassembly.py``: reassembly of the fragments;
- ``gdp/message/frame_recovery.py``: lost frames from parity;
- ``delivery.py``: messages that wait behind a gap, messages in order, and losses;
- ``gdp/message/late_repairs.py``: what is requested again of a best-effort topic, and how long that is awaited;
- ``ack_nack_schedule.py``: when a report is due;
- ``ack_nack_sealer.py``: the keys under which it is sealed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from enum import Enum
from functools import partial
from typing import Final

from gdp import burst
from gdp.client.ack_nack_schedule import AckNackSchedule
from gdp.client.ack_nack_sealer import AckNackSealer
from gdp.client.delivery import NOT_BEGUN, Delivery, Ended
from gdp.client.identities import PublisherIdentity, ReaderIdentity
from gdp.client.key_epochs import Openers, Secrets
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import HOPS_AT, SECOND_PATH, Flag, Header, Kind, decode, second_path_copy
from gdp.intervals import NEVER_S, READER
from gdp.limits import (
    COST_UNREACHABLE,
    NACKS_PER_REPORT,
    NUMBER_MAX,
    PACE_MAX,
    REPLAY_WINDOW_MESSAGES,
    REPORT_DELAY_S,
    SEQUENCE_BYTES,
    SPREAD,
    STRIPES_FROM_PARTS,
)
from gdp.message.acknack import FRAMES_MASK, AckNack, AckNackFlag, MissingRange
from gdp.message.frame_recovery import FrameRecovery
from gdp.message.heartbeat import Heartbeat
from gdp.message.late_repairs import LateRepairs
from gdp.message.reassembly import ReassembledMessage, Reassembler
from gdp.message.receipts import RECEIPTS_MASK
from gdp.message.second_copies import DeferredRequests, SecondCopies
from gdp.message.striping import StripedPaths
from gdp.names import Name
from gdp.sansio import ReceivedFrame, new_tuple
from gdp.trust.advertisement import Advertisement

ANNOUNCE_S: Final = 0.1
_LATCHED: Final = int(Flag.LATCHED)
_WAITING: Final = int(Flag.RELIABLE | Flag.LATCHED)  # topics whose readers wait for what is missing


class WriterProxyState(Enum):
    """State of a writer proxy."""

    NEW = "new"
    LIVE = "live"


class WriterProxy:
    """Reader's state of one incarnation of one publisher of a topic.

    Args:
        secrets: of the topic, or of a session.
        before: where an earlier writer proxy of the same ended. A latched topic's last messages come again, as its
            publisher announces in a new Heartbeat, unless this writer proxy resumes that one.
        waits_since_s: when the topic was subscribed.
        introduces: the publisher gets the reader's key by an introduction, and announces where to begin. Else it knows
            the key already, and the stream is reliable and begins at the first message.

    Attributes:
        advertisement: newest advertisement of the publisher.
        description: the publisher's description of its messages.
        delivery: messages that wait or are ready, in order, and losses.
        losses: which messages are known to be lost, and why.
        recovery: lost frames that parity has restored.
        schedule: when reports are due.
        second_path_s: when a frame of the publisher last came by a second path.
        pace: that the publisher gave this reader, to be stated to its switch.
        cost: of the path to the publisher's switch, as ours states it if asked.

    Raises:
        StatementError: MALFORMED, the publisher's ``exchange`` is no key.
    """

    def __init__(
        self,
        *,
        topic: Name,
        reader: ReaderIdentity,
        publisher: PublisherIdentity,
        secrets: Secrets,
        now_s: float,
        before: Ended = NOT_BEGUN,
        waits_since_s: float | None = None,
        introduces: bool = True,
    ) -> None:
        self.publisher = name = publisher.name
        self.incarnation = incarnation = publisher.incarnation
        self.topic = topic
        self.exchange = publisher.exchange
        self._reader = reader
        self._keys = Openers(secrets, name, incarnation, topic, is_signed=publisher.key is not None)
        self._before = before
        self._waits_since_s = now_s if waits_since_s is None else waits_since_s
        self._described = 0  # number of the Heartbeat that brought it
        self.recovery = FrameRecovery(name, reader.budget)
        self._sealer = AckNackSealer(
            topic=topic, reader=reader, publisher=publisher, secrets=secrets, introduces=introduces, now_s=now_s
        )
        key, budget, opener = publisher.key, reader.budget, self._keys.opener
        self._data = Reassembler(name, partial(opener, Kind.DATA), key, budget)
        self.set_head(0)
        self._status = Reassembler(name, partial(opener, Kind.HEARTBEAT), key, budget)
        self.schedule = AckNackSchedule(self._data, now_s)
        self._copies: SecondCopies | StripedPaths | None = None
        self._striped: StripedPaths | None = None  # the same, of a publisher that stripes
        self._deferred = DeferredRequests()
        self._late = LateRepairs(self._data, self._lag_s, self.recovery.awaited_s)
        self.delivery = Delivery(
            name, incarnation, budget, data=self._data, recovery=self.recovery, late=self._late, lag_s=self._lag_s
        )
        self.losses = self.delivery.losses
        self._sent = (0, 0)  # the publisher has sent everything before this (number, fragment)
        self.state = WriterProxyState.NEW
        self.description = b""
        self.advertisement: Advertisement | None = None
        self.advertisement_sequence = 0
        self.second_path_s = float("-inf")
        self.pace = PACE_MAX
        self.cost = COST_UNREACHABLE
        self._paced_by = 0  # number of the Heartbeat that brought it
        if not introduces:
            self.state = WriterProxyState.LIVE
            self._set_reliable(_WAITING)
            self.delivery.begin_at(max(before.number, 1), max(before.sequence, 1))
            self.schedule.due_s = now_s + READER.refresh_s

    @property
    def paths(self) -> int:
        """Return over how many paths frames of this publisher come, and reports to it go."""
        if self._copies is None:
            return 1
        return 2 if self._striped is None else SPREAD

    @paths.setter
    def paths(self, paths: int) -> None:
        """Set over how many paths frames come and reports go."""
        if paths != self.paths:
            self._striped = StripedPaths() if paths == SPREAD else None
            self._copies = SecondCopies() if paths > 1 and self._striped is None else self._striped
            self._data.copies, self._status.copies = self._copies, SecondCopies() if paths > 1 else None

    def set_head(self, head_bytes: int) -> None:
        """Deliver so many bytes of each message apart."""
        self._data.head_bytes = SEQUENCE_BYTES + head_bytes

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        return self._data.drops + self._status.drops

    @property
    def full_parts(self) -> int:
        """Return how many fragments of full size came, of messages that need several."""
        return self._data.full_parts

    @property
    def ended(self) -> Ended:
        """Return where it ended, for a later one that continues after it."""
        before, delivery = self._before, self.delivery
        status = max(self._status.window.top, before.status)
        if self.state is WriterProxyState.NEW:
            return before._replace(status=status)
        number, known = max(self.delivery.expected, before.number), max(delivery.known, delivery.sequence)
        return Ended(number, status, delivery.sequence, known)

    def receive(self, header: Header, frame: bytes, now_s: float, waited_s: float) -> None:
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
            header, last = decode(arrivals[at].frame), arrivals[at + taken - 1]
            number, part = header.number, header.part + taken - 1
            if self._striped is not None:
                second = sum(each.frame[HOPS_AT] & SECOND_PATH > 0 for each in arrivals[at : at + taken])
                self._striped.handle_arrivals(number, taken - second, second, now_s)
            self.recovery.keep_run(arrivals, at, taken, now_s)
            samples = burst.samples(arrivals, at, taken)
            is_in_order = self._data.progress(number) > part
            size = len(last.frame) if is_in_order else header.length
            self.schedule.count(taken * size, taken, samples, number, part, now_s - last.waited_s)
            if self.state is WriterProxyState.LIVE:
                self.schedule.handle_run(now_s, is_in_order=is_in_order)
                if not is_in_order and not self.delivery.is_reliable:
                    self._late.handle_part(header, now_s, taken)
        return taken

    def handle_timer(self, now_s: float) -> None:
        """Drop what waited too long for its fragments, and go on without what neither path brought (best effort)."""
        is_final = self.state is WriterProxyState.LIVE and not self.delivery.is_reliable
        self.delivery.handle_timer(now_s)
        if self._data.unfinished_bytes:
            self._data.drop_expired(now_s, for_good=is_final)
        if self._status.unfinished_bytes:
            self._status.drop_expired(now_s, for_good=False)
        if self.recovery.messages:
            self.recovery.drop_expired(now_s)

    def get_timer(self) -> float:
        """Return the monotonic second of the next timer."""
        delivery, late, data, status = self.delivery, self._late, self._data, self._status
        due_s = self.schedule.due_s
        for each_s in (delivery.gap_until_s, late.due_s, late.hold_s):
            due_s = each_s if each_s < due_s else due_s
        if delivery.held:
            due_s = min(due_s, delivery.held[0][0])
        if self.recovery.messages:
            due_s = min(due_s, self.recovery.next_expiry())
        if status.unfinished_bytes or data.unfinished_bytes:
            for expiry in (status.next_expiry(), data.next_expiry()):
                if expiry is not None and expiry < due_s:
                    due_s = expiry
        return due_s

    def is_report_due(self, now_s: float) -> bool:
        """Return whether ``control_to_send`` has a report now."""
        return now_s >= self.schedule.due_s or (self._late.due_s < NEVER_S and self._late.is_due(now_s))

    def control_to_send(self, now_s: float) -> list[bytes]:
        """Return the frames of the report that is due, if one is, and of an introduction if it is wanted."""
        schedule = self.schedule
        late = self._late.poll_missing(now_s) if self._late.due_s < NEVER_S and self._late.is_due(now_s) else ()
        if now_s < schedule.due_s and not late:
            return []
        schedule.start_report()
        if self.state is WriterProxyState.NEW:
            schedule.due_s = now_s + ANNOUNCE_S
            number, sequence = (self._before.number, self._before.sequence) if self._before.resumes else (0, 0)
            waited_us = max(round((now_s - self._waits_since_s) * 1e6), 0)
            acknack = AckNack(AckNackFlag.NEW, number, 0, (), sequence, held_us=waited_us)
            return self._over_paths(self._sealer.seal_first(acknack))
        missing, awaited_s = self._missing(now_s) if self.delivery.is_reliable else ((), NEVER_S)
        if (self._copies is not None or self._data.repeats.copies) and self.delivery.is_reliable:
            missing = self._deferred.poll_due(missing, self._lag_s(), now_s)
        schedule.handle_reported(now_s, is_missing=bool(missing))
        for each_s in (self._deferred.due_s, awaited_s):
            schedule.due_s = each_s if each_s < schedule.due_s else schedule.due_s
        expected = self.delivery.expected
        part, sequence = self._data.progress(expected) if self._data.unfinished_bytes else 0, self.delivery.sequence
        share = 0 if self._striped is None else self._striped.poll_share()
        flags = AckNackFlag.NONE
        if self.pace < PACE_MAX:
            flags, share = AckNackFlag.PACED, self.pace
        newest, newest_part, came_s = schedule.newest
        held_us = round((now_s - came_s) * 1e6)
        acknack = new_tuple(AckNack, (
            flags, expected, part, missing or late, sequence, self.losses.total, share,
            schedule.received, newest, newest_part if newest_part > 0 else 0, held_us if held_us > 0 else 0,
            (self._data.frames - self.recovery.recovered) & FRAMES_MASK, schedule.receipts & RECEIPTS_MASK,
        ))  # fmt: skip
        return self._over_paths(self._sealer.seal_all(acknack, now_s))

    def close(self) -> list[bytes]:
        """Release all memory; return the frames of the goodbye."""
        self._data.close()
        self._status.close()
        self.recovery.close()
        self.delivery.close()
        self._late.close()
        self.schedule.due_s = NEVER_S
        delivery, expected = self.delivery, self.delivery.expected
        acknack = AckNack(AckNackFlag.BYE, expected, 0, (), delivery.sequence, self.losses.total)
        return self._over_paths([self._sealer.seal(acknack)])

    def renew(self, secrets: Secrets) -> None:
        """Replace the topic's secrets; an epoch that is still among them opens as before."""
        self._keys.renew(secrets)
        self._sealer.renew(secrets)

    def _over_paths(self, notes: list[bytes]) -> list[bytes]:
        """Return notes, and their second copies if there are two paths."""
        return notes if self._copies is None else [*notes, *map(second_path_copy, notes)]

    def _handle_parity(self, header: Header, frame: bytes, now_s: float) -> None:
        """Restore what is lost, as far as parity suffices; it arrives now, and counts as lost on the way."""
        try:
            if self._data.window.is_finished(header.number):
                raise EnvelopeError(DropReason.UNUSED_PARITY, "its message is complete")
            body = self._keys.parity(header.epoch).open(header, frame)
            restored = self.recovery.add_parity(header, body, now_s)
        except EnvelopeError as error:
            self._data.drops[error.reason] += 1
            return
        for each in restored:
            self._handle_data(decode(each), each, now_s, now_s, is_restored=True)

    def _handle_data(
        self, header: Header, frame: bytes, now_s: float, came_s: float, *, is_restored: bool = False
    ) -> None:
        reassembler, expected = self._data, self.delivery.expected
        if header.number > NUMBER_MAX:
            reassembler.drops[DropReason.MALFORMED] += 1
            return
        if self.state is WriterProxyState.LIVE and not 0 <= header.number - expected < REPLAY_WINDOW_MESSAGES:
            if header.number < expected:
                reassembler.drop_copy(header, DropReason.LATE, now_s)
            else:
                reassembler.drops[DropReason.MEMORY_FULL] += 1
            return
        striped, is_done = self._striped, False
        if striped is not None:
            is_done = reassembler.window.is_finished(header.number)
        is_whole = header.parts == 1
        seen, highest = reassembler.new_parts, reassembler.highest
        refused = 0 if is_whole else reassembler.drops[DropReason.MEMORY_FULL]
        reassembled = reassembler.add(header, frame, now_s)
        is_first = reassembler.new_parts > seen
        if striped is not None and header.parts >= STRIPES_FROM_PARTS and not is_done and (is_first or not header.part):
            second = int(header.hops_left & SECOND_PATH > 0)
            striped.handle_arrivals(header.number, 1 - second, second, now_s)
        if is_first:
            if self.delivery.is_reliable is None:
                self._set_reliable(header.flags)
            self.recovery.recovered += is_restored
            came = 1 - is_restored
            samples = burst.samples((frame,), 0, came)
            self.schedule.count(header.length, came, samples, header.number, header.part, came_s)
            if reassembled is None:
                self.recovery.keep(header, frame, now_s)
            if self.state is WriterProxyState.LIVE:
                self.schedule.handle_part(header, highest, expected, now_s)
                if reassembled is None and not self.delivery.is_reliable:
                    self._late.handle_part(header, now_s)
        if reassembled is not None:
            if self.recovery.messages:
                self.recovery.forget(header.number)
            if self.state is WriterProxyState.LIVE and not self.delivery.is_reliable:
                self._late.handle_complete(reassembled.number, header.part, now_s)
            if striped is not None:
                striped.handle_complete(reassembled.number)
                if striped.has_news:
                    self.schedule.due_s = min(self.schedule.due_s, now_s + REPORT_DELAY_S)
            self._sealer.handle_message(reassembled.number, header.epoch, now_s)
            self.delivery.add(reassembled, now_s)
        elif not is_whole and reassembler.drops[DropReason.MEMORY_FULL] > refused:
            self.delivery.skip_gap(now_s)

    def _missing(self, now_s: float) -> tuple[tuple[MissingRange, ...], float]:
        """Return what is known to be missing, and the first second at which parity may no longer fill what else is.

        That is gaps below the newest fragment, and all that a Heartbeat announced.
        """
        missing: list[MissingRange] = []
        due_s = NEVER_S
        sent_number, sent_part = self._sent
        end = max(self._data.highest + 1, sent_number + (sent_part > 0))
        expected = self.delivery.expected
        for number in self._data.window.unfinished(expected, end) if expected < end else ():
            capacity = NACKS_PER_REPORT - len(missing)
            if capacity <= 0:
                break
            awaited_s = self.recovery.awaited_s(number, now_s)
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
            is_latched = bool(reassembled.flags & _LATCHED)
            self.delivery.begin_stream(status, start, self._before, is_latched=is_latched)
            self.state = WriterProxyState.LIVE
        if status.description and reassembled.number > self._described:
            self.description, self._described = status.description, reassembled.number
        for reader, pace in status.paces:
            if reader == self._reader.name and reassembled.number > self._paced_by:
                self.pace, self._paced_by = pace, reassembled.number
                self.delivery.is_thinned = pace < PACE_MAX
        self._sent = max(self._sent, (status.sent_number, status.sent_part))
        self.delivery.handle_heartbeat(status, now_s, is_newest=is_newest)
        self.schedule.due_s = now_s

    def _set_reliable(self, flags: int) -> None:
        self.delivery.is_reliable = bool(flags & _WAITING)
        if self.delivery.is_reliable:
            self._late.close()

    def _lag_s(self) -> float:
        """Return how long a copy may take to bring what the faster path, or the first frame, did not; 0: none comes."""
        return self._data.repeats.lag_s() if self._copies is None else self._copies.lag_s()


def _below(ranges: list[tuple[int, int]], end: int) -> list[tuple[int, int]]:
    """Return the parts of inclusive ranges that lie below ``end``."""
    return [(first, min(last, end - 1)) for first, last in ranges if first < end]
