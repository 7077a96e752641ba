"""One publisher of one topic as a reader sees it: open, join, put in order, report what is missing.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A feed begins ``NEW``: it introduces itself until a status tells it where to begin and what messages are. ``LIVE`` it
delivers: a reliable topic in order and complete, a best-effort one in order and never waiting. Sequence numbers under
the seal show what is lost between two messages, statuses what is lost behind the last, and why.

Reports go under the epoch of the newest verified message. A publisher that is silent may have begun another epoch, or
have forgotten this reader: now and then it is told under another epoch too, with an introduction.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gdp.client.reading import Delivered, Ended, FeedState, Reader
from gdp.client.source import Secrets
from gdp.crypto.envelope import Opener, seal_key
from gdp.crypto.note import NoteSealer, note_key
from gdp.effects import Arrival
from gdp.errors import DropReason, EnvelopeError, RemoteError
from gdp.frame.codec import Header
from gdp.frame.kinds import Flag, Kind
from gdp.limits import (
    NACKS_PER_REPORT,
    NUMBER_MAX,
    REPLAY_WINDOW_MESSAGES,
    REPORT_DELAY_S,
    REPORT_EVERY_BYTES,
    REPORT_EVERY_MAX_BYTES,
    REPORT_GAP_S,
    REPORT_IDLE_S,
    REPORT_PAUSE_S,
    SEQUENCE_BYTES,
)
from gdp.message.bundle import unpack
from gdp.message.join import Joined, Joiner, VerifiesDigest
from gdp.message.loss import Losses, LossReason, LostRange, explain
from gdp.message.memory import Budget
from gdp.message.move import Move
from gdp.message.report import Missing, Report, ReportFlag
from gdp.message.status import Start, Status
from gdp.names import Name
from gdp.trust.claim import Claim

__all__ = ["Delivered", "Ended", "Feed", "FeedState", "Reader"]

ANNOUNCE_S: Final = 0.1
ANNOUNCE_TRIES: Final = 3  # under one epoch, before the next is tried
SILENT_S: Final = 3.0  # without a message or a status, until a publisher is told again who reads
_READY_OVERHEAD_BYTES: Final = 256  # what a message that waits for others costs beside its bytes
_BUNDLE: Final = int(Flag.BUNDLE)
_LATCHED: Final = int(Flag.LATCHED)
_WAITING: Final = int(Flag.RELIABLE | Flag.LATCHED)  # topics whose readers wait for what is missing
_NOWHERE: Final = Ended()


class Feed:
    """Reads one incarnation of one publisher of a topic.

    Args:
        exchange: the publisher's X25519 key, as its claim names it.
        ended: where an earlier feed of the same ended. A latched topic's last messages come again all the same, as its
            publisher says in a new status, unless this feed resumes that one.
        restarted: this reader read another life of the publisher before: what was published in this one is lost.

    Raises:
        StatementError: MALFORMED, ``exchange`` is no key.
    """

    def __init__(
        self,
        topic: Name,
        reader: Reader,
        publisher: Name,
        incarnation: int,
        writer: VerifiesDigest,
        exchange: bytes,
        secrets: Secrets,
        budget: Budget,
        now_s: float,
        ended: Ended = _NOWHERE,
        *,
        restarted: bool = False,
    ) -> None:
        self.publisher = publisher
        self.incarnation = incarnation
        self.topic = topic
        self._reader = reader
        self._secrets = secrets
        self._budget = budget
        self._before = ended
        self._described = 0  # by which status
        self._openers: dict[tuple[int, int], Opener] = {}
        self._announced = 0
        self.exchange = exchange
        self._shared = reader.notes.shared(exchange)
        self._epoch = max(secrets)  # of reports
        self._notes: dict[int, NoteSealer] = {}
        self._epoch_at = -1  # number of the message that says so
        self._silent_s = now_s  # since when its publisher is silent, or was last told who reads
        self._data = Joiner(
            publisher, lambda epoch: self._opener(Kind.DATA, epoch), writer, budget, head_bytes=SEQUENCE_BYTES
        )
        self._status = Joiner(publisher, lambda epoch: self._opener(Kind.STATUS, epoch), writer, budget)
        self.state = FeedState.NEW
        self.description = b""
        self._is_reliable: bool | None = None
        self._expected = 0  # next number to deliver, once LIVE
        self._sequence = 0  # of the next message, once LIVE
        self._known = 0  # the first sequence number of which nothing is known
        self._gone: tuple[LostRange, ...] = ()  # what the publisher says that nobody can get
        self._skipped: LossReason | None = None  # why it went on without what lacks
        self._is_restarted = restarted
        self._sent = (0, 0)  # the publisher has sent everything before this (number, part)
        self._ready: dict[int, Joined] = {}  # whole, behind a gap
        self._out = deque[Delivered]()
        self._report_at_s = now_s
        self._unreported_bytes = 0
        self._clean_bytes = 0  # reported since something was last missing
        self.idle_s = REPORT_IDLE_S  # it reports at least so often
        self.claim: Claim | None = None  # of the publisher, the newest
        self.claim_sequence = 0
        self.losses = Losses()
        self.delivered = 0

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was dropped, by reason."""
        return self._data.drops + self._status.drops

    @property
    def lost(self) -> int:
        """Return how many messages are known to be lost."""
        return self.losses.total

    @property
    def ended(self) -> Ended:
        """Return where it is, for one that goes on after it."""
        before = self._before
        if self.state is FeedState.NEW:
            return before._replace(status=max(self._status.window.top, before.status))
        number, status = max(self._expected, before.number), max(self._status.window.top, before.status)
        return Ended(number, status, self._sequence, max(self._known, self._sequence))

    def finish(self) -> None:
        """Hand out what is whole, and count what is known to lack: no more of this life of its publisher will come."""
        if self.state is FeedState.LIVE:
            self._skipped = LossReason.PUBLISHER_RESTARTED
            for number in sorted(self._ready):
                self._hand_out(self._take_ready(number))
            self._lose_until(self._known, LossReason.PUBLISHER_RESTARTED)

    def receive(self, header: Header, frame: bytes, now_s: float) -> None:
        """Take one DATA or STATUS frame of this publisher."""
        if header.incarnation != self.incarnation:
            self._data.drops[DropReason.WRONG_INCARNATION] += 1
        elif header.kind == Kind.STATUS and header.number <= self._before.status:
            self._status.drops[DropReason.REPLAYED] += 1
        elif header.kind == Kind.STATUS:
            joined = self._status.add(header, frame, now_s)
            if joined is not None:
                self._take_status(joined, header.epoch, now_s)
        else:
            self._take_data(header, frame, now_s)

    def receive_run(self, arrivals: Sequence[Arrival], at: int, now_s: float) -> int:
        """Take the frames of ``arrivals[at:]`` that carry on with the message under way; return how many."""
        taken = self._data.add_run(arrivals, at, now_s)
        if taken:
            self._unreported_bytes += taken * len(arrivals[at].frame)
            if self.state is FeedState.LIVE and self._is_reliable:
                self._report_at_s = min(self._report_at_s, now_s if self._owes_report() else now_s + REPORT_PAUSE_S)
        return taken

    def timeout(self, now_s: float) -> None:
        """Give back what waited too long for its parts (best effort), and let a due report go."""
        is_final = self.state is FeedState.LIVE and not self._is_reliable
        self._data.expire(now_s, for_good=is_final)
        self._status.expire(now_s, for_good=False)

    def next_timeout(self) -> float:
        """Return the monotonic second of the next timer."""
        expiries = [self._status.next_expiry(), self._data.next_expiry()]
        return min([self._report_at_s, *(expiry for expiry in expiries if expiry is not None)])

    def take_notes(self, now_s: float) -> list[bytes]:
        """Return the frames of the report that is due, if one is, and of an introduction where it is wanted."""
        if now_s < self._report_at_s:
            return []
        self._clean_bytes += self._unreported_bytes
        self._unreported_bytes = 0
        if self.state is FeedState.NEW:
            self._report_at_s = now_s + ANNOUNCE_S
            epoch = self._epoch = self._epoch_to_try()
            number, sequence = (self._before.number, self._before.sequence) if self._before.resumes else (0, 0)
            hello = Report(ReportFlag.NEW, number, 0, (), sequence)
            return [*self._introduce(epoch), self._note(epoch).seal(hello.to_wire())]
        missing = self._missing() if self._is_reliable else ()
        if missing:
            self._clean_bytes = 0
        self._report_at_s = now_s + (REPORT_DELAY_S if missing else self.idle_s)
        part = self._data.progress(self._expected)
        report = Report(ReportFlag.NONE, self._expected, part, missing, self._sequence, self.lost).to_wire()
        notes = [self._note(self._epoch).seal(report)]
        if now_s - self._silent_s >= SILENT_S:
            self._silent_s = now_s
            epoch = self._epoch_to_try()
            notes += self._introduce(epoch)
            if epoch != self._epoch:
                notes.append(self._note(epoch).seal(report))
        return notes

    def take_delivered(self) -> list[Delivered]:
        """Return, once, the messages that are ready, in order."""
        delivered = list(self._out)
        self._out.clear()
        return delivered

    def close(self) -> bytes:
        """Give back all memory; return the frame that says goodbye."""
        self._data.close()
        self._status.close()
        for number in list(self._ready):
            self._take_ready(number)
        self._report_at_s = float("inf")
        report = Report(ReportFlag.BYE, self._expected, 0, (), self._sequence, self.lost)
        return self._note(self._epoch).seal(report.to_wire())

    def renew(self, secrets: Secrets) -> None:
        """Take the topic's secrets anew; what is sealed under an epoch that is still among them opens as before."""
        self._secrets = secrets
        self._openers.clear()
        self._notes.clear()
        if self._epoch not in secrets:
            self._epoch = max(secrets)

    def _note(self, epoch: int) -> NoteSealer:
        """Return what seals reports under an epoch."""
        sealer = self._notes.get(epoch)
        if sealer is None:
            reader = self._reader
            ends = reader.name, reader.incarnation, self.publisher, self.incarnation
            key = note_key(self._shared, self._secrets[epoch], Kind.REPORT, *ends, self.topic)
            sealer = self._notes[epoch] = self._note_sealer(key, epoch, Kind.REPORT)
        return sealer

    def _introduce(self, epoch: int) -> list[bytes]:
        """Return the frames that say whose reports these are, for who holds the secret of an epoch."""
        reader = self._reader
        key = seal_key(self._secrets[epoch], Kind.INTRODUCTION, reader.name, reader.incarnation, self.publisher)
        return [self._note_sealer(key, epoch, Kind.INTRODUCTION).seal(reader.introduction())]

    def _note_sealer(self, key: bytes, epoch: int, kind: Kind) -> NoteSealer:
        reader, to = self._reader, (self.publisher, self.topic, self.incarnation)
        return NoteSealer(key, epoch, kind, reader.name, reader.incarnation, *to, reader.note_numbers)

    def _epoch_to_try(self) -> int:
        """Return the epoch to announce under: the newest, and in turn the others, for the publisher may lag behind."""
        epochs = sorted(self._secrets, reverse=True)
        epoch = epochs[self._announced // ANNOUNCE_TRIES % len(epochs)]
        self._announced += 1
        return epoch

    def _opener(self, kind: Kind, epoch: int) -> Opener:
        opener = self._openers.get((kind, epoch))
        if opener is None:
            secret = self._secrets.get(epoch)
            if secret is None:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(epoch))
            opener = Opener(secret, kind, self.publisher, self.incarnation, self.topic)
            self._openers[kind, epoch] = opener
        return opener

    def _take_data(self, header: Header, frame: bytes, now_s: float) -> None:
        joiner = self._data
        if header.number > NUMBER_MAX:
            joiner.drops[DropReason.MALFORMED] += 1
            return
        if self.state is FeedState.LIVE and not 0 <= header.number - self._expected < REPLAY_WINDOW_MESSAGES:
            joiner.drops[DropReason.LATE if header.number < self._expected else DropReason.MEMORY_FULL] += 1
            return
        seen, highest, refused = joiner.new_parts, joiner.highest, joiner.drops[DropReason.MEMORY_FULL]
        joined = joiner.add(header, frame, now_s)
        if joiner.new_parts > seen:
            if self._is_reliable is None:
                self._is_reliable = bool(header.flags & _WAITING)
            self._unreported_bytes += header.length
            self._plan_report(header, highest, now_s)
        if joined is not None:
            self._silent_s = now_s
            if joined.number >= self._epoch_at:
                self._epoch, self._epoch_at = header.epoch, joined.number
            self._arrange(joined)
        elif joiner.drops[DropReason.MEMORY_FULL] > refused and self.state is FeedState.LIVE and self._ready:
            self._skipped = LossReason.READER_MEMORY
            self._skip_to(min(self._ready))  # what waits behind the gap leaves no room to fill it: go on without
            self._deliver()

    def _arrange(self, joined: Joined) -> None:
        """Put a whole message where it belongs, and hand out what is next."""
        if self.state is FeedState.LIVE and (not self._is_reliable or joined.number == self._expected):
            if joined.number > self._expected:
                self._skip_to(joined.number)
            self._hand_out(joined)
            self._expected = joined.number + 1
            self._deliver()
        elif self._budget.reserve(self.publisher, len(joined.message) + _READY_OVERHEAD_BYTES):
            self._ready[joined.number] = joined
            self._known = max(self._known, min(int.from_bytes(joined.head, "big"), NUMBER_MAX) + 1)
        elif self.state is FeedState.NEW:
            self._data.drops[DropReason.MEMORY_FULL] += 1
        else:
            self._skipped = LossReason.READER_MEMORY
            self._skip_to(joined.number)
            self._hand_out(joined)
            self._expected += 1
            self._deliver()

    def _plan_report(self, header: Header, highest: int, now_s: float) -> None:
        if self.state is FeedState.NEW or not self._is_reliable:
            return
        soonest_s = now_s + REPORT_DELAY_S
        if header.parts == 1 and header.number == highest + 1 == self._expected and self._report_at_s <= soonest_s:
            if self._owes_report():
                self._report_at_s = now_s
            return  # a whole message in its turn changes nothing else
        is_next = header.number == highest or (header.number == highest + 1 and self._is_whole(highest))
        is_in_order = is_next and (
            self._data.is_finished(header.number) or header.part == self._data.progress(header.number) - 1
        )
        if self._owes_report():
            due_s = now_s
        elif not is_in_order:
            due_s = now_s + REPORT_GAP_S
        else:
            due_s = now_s + (REPORT_DELAY_S if self._data.is_finished(header.number) else REPORT_PAUSE_S)
        self._report_at_s = min(self._report_at_s, due_s)

    def _owes_report(self) -> bool:
        """Return whether a report is due for how much has come; the longer all is well, the more that takes.

        A publisher's flight has grown by what was reported since the last loss, and should never run dry.
        """
        every_bytes = max(REPORT_EVERY_BYTES, min(self._clean_bytes // 4, REPORT_EVERY_MAX_BYTES))
        return self._unreported_bytes >= every_bytes

    def _is_whole(self, number: int) -> bool:
        return number < self._expected or self._data.is_finished(number)

    def _missing(self) -> tuple[Missing, ...]:
        """Return what is known to be lacking: gaps below the newest part, and all that a status announced."""
        missing: list[Missing] = []
        sent_number, sent_part = self._sent
        end = max(self._data.highest + 1, sent_number + (sent_part > 0))
        for number in self._data.window.unfinished(self._expected, end):
            room = NACKS_PER_REPORT - len(missing)
            if room <= 0:
                break
            ranges = self._data.missing(number, room, to_end=number < sent_number)
            if not ranges and number == sent_number:
                ranges = _below(self._data.missing(number, room, to_end=True), sent_part)
            missing += [Missing(number, *each) for each in ranges]
        return tuple(missing)

    def _take_status(self, joined: Joined, epoch: int, now_s: float) -> None:
        try:
            status = Status.from_wire(joined.message)
        except RemoteError as error:
            self._status.drops[error.reason] += 1
            return
        self._is_reliable = bool(joined.flags & _WAITING)
        self._silent_s = now_s
        if joined.number == self._status.window.top:
            self._epoch = epoch
        if self.state is FeedState.NEW:
            start = status.starts.get(self._reader.name)
            if start is None or start.incarnation != self._reader.incarnation:
                return
            self.state = FeedState.LIVE
            self._begin(status, start, is_latched=bool(joined.flags & _LATCHED))
            for number in [n for n in self._ready if not 0 <= n - self._expected < REPLAY_WINDOW_MESSAGES]:
                self._take_ready(number)
            self._data.begin(self._expected, self._ready)
        if status.description and joined.number > self._described:
            self.description, self._described = status.description, joined.number
        if joined.number == self._status.window.top:
            self._gone = status.gone
        self._sent = max(self._sent, (status.sent_number, status.sent_part))
        for move in status.moves:
            if move.is_before(self._expected):
                self._follow(move)
        otherwise = LossReason.GIVEN_UP if self._is_reliable else LossReason.GAP
        if status.oldest > self._expected:
            self._skip_to(status.oldest)
            self._lose_until(status.oldest_sequence, otherwise)
        self._deliver()
        if self._expected == status.sent_number:
            self._lose_until(status.sent_sequence, otherwise)
        self._known = max(self._known, status.sent_sequence)
        self._report_at_s = now_s

    def _begin(self, status: Status, start: Start, *, is_latched: bool) -> None:
        """Begin where the publisher says, and count what came between this and what was read before."""
        before = self._before
        self._expected = start.number
        if before.resumes or not is_latched:
            self._expected = max(start.number, before.number)
        begun, why = start.confirmed, LossReason.READER_RESTARTED
        if before.resumes and before.sequence:
            begun, why = before.sequence, LossReason.DETACHED
        elif self._is_restarted:
            begun, why = 1, LossReason.PUBLISHER_RESTARTED
        self._gone = status.gone if why is LossReason.DETACHED else ()
        self._sequence = begun or start.sequence
        self._lose_until(start.sequence, why)
        self._gone = status.gone
        self._sequence = max(start.sequence, before.sequence) if self._expected > start.number else start.sequence

    def _follow(self, move: Move) -> None:
        """Go on under new numbers: what is here of the old ones waits, under theirs, for what lacks."""
        if self._expected < move.first:
            self._skip_to(move.first)
        self._expected = move.of(self._expected)
        early = {number: self._take_ready(number) for number in list(self._ready) if move.is_before(number)}
        for number in [number for number in self._ready if number < self._expected]:
            self._take_ready(number)  # it was handed out under its old number
        self._data.forget(self._expected)
        for old, joined in early.items():
            number, size = move.of(old), len(joined.message) + _READY_OVERHEAD_BYTES
            if number not in self._ready and self._budget.reserve(self.publisher, size):
                self._ready[number] = replace(joined, number=number)
                self._data.skip(number)

    def _skip_to(self, number: int) -> None:
        """Accept that what lies before ``number`` and is not here will not come."""
        for each in sorted(each for each in self._ready if each < number):
            self._hand_out(self._take_ready(each))
        self._expected = number
        self._data.forget(number)

    def _deliver(self) -> None:
        if self.state is FeedState.NEW:
            return
        while self._expected in self._ready:
            self._hand_out(self._take_ready(self._expected))
            self._expected += 1
        if self._ready and not self._is_reliable:
            self._skip_to(max(self._ready) + 1)

    def _take_ready(self, number: int) -> Joined:
        joined = self._ready.pop(number)
        self._budget.release(self.publisher, len(joined.message) + _READY_OVERHEAD_BYTES)
        return joined

    def _lose_until(self, sequence: int, otherwise: LossReason) -> None:
        """Count what lies before a message as lost."""
        if self._sequence < sequence:
            for lost in explain(self._sequence, sequence - 1, self._gone, otherwise):
                self.losses.add(lost)
            self._sequence = sequence

    def _hand_out(self, joined: Joined) -> None:
        sequence, messages = int.from_bytes(joined.head, "big"), [joined.message]
        if len(joined.head) < SEQUENCE_BYTES or sequence > NUMBER_MAX:
            self._data.drops[DropReason.MALFORMED] += 1
            return
        if joined.flags & _BUNDLE:
            try:
                messages = unpack(joined.message)
            except RemoteError as error:
                self._data.drops[error.reason] += 1
                return
        otherwise, self._skipped = self._skipped or (LossReason.GIVEN_UP if self._is_reliable else LossReason.GAP), None
        self._lose_until(sequence, otherwise)
        self._sequence = max(self._sequence, sequence + len(messages))
        self.delivered += len(messages)
        number, way = joined.number, (joined.parts, joined.hops)
        for place, message in enumerate(messages):
            at = place, sequence + place
            self._out.append(Delivered(self.publisher, self.incarnation, number, message, *way, *at))


def _below(ranges: list[tuple[int, int]], end: int) -> list[tuple[int, int]]:
    """Return inclusive ranges as far as they lie below ``end``."""
    return [(first, min(last, end - 1)) for first, last in ranges if first < end]
