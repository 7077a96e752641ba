"""One topic as its publisher sees it: number, seal, keep, pace, repair.

Place: pure; time comes in as ``now_s`` (monotonic seconds). Frames come out of ``take`` and go to the switch.

A small message waits until frames are asked for, and those that wait together become one bundle, sealed and signed once
(``gdp/message/bundle.py``); not of a latched topic, whose late joiners get so many messages and no more.

A message is sealed once. Where the path has become too narrow for what is kept, that is split anew, and all that is
kept moves to new numbers; statuses say which (``gdp/message/move.py``). Without a reader nothing is sealed; the last
``depth`` messages of a latched topic wait for late joiners.

Each message has a sequence number under its seal, sent or not (``gdp/message/ledger.py``). So a reader that finds a gap
knows how many messages it lost, and statuses say why.

A reader is known by its introduction, and by notes that nobody else can make. One that falls silent is suspended: it
holds nothing up, and what it lacks is kept for a grace time, as far as there is room. One that stands still, or lags
while others are through, holds the window no longer: it gets what is sent, and is told to skip what is gone, until
after a penance it may hold the window again.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from gdp.client.best_effort import Carried, Unsent
from gdp.client.kept import Kept
from gdp.client.pasts import FIRST, Past
from gdp.client.readers import TOPICS, Patience, Readers, Reading
from gdp.client.source import Secrets, Source
from gdp.client.statuses import Statuses
from gdp.crypto.envelope import SIGNATURE_BYTES, Sealed, Sealer, part_room
from gdp.errors import DropReason, EnvelopeError, LocalError, RemoteError
from gdp.frame.codec import Header
from gdp.frame.kinds import Flag, Kind
from gdp.limits import EPOCH_GRACE_S, MTU_MIN_BYTES, SEQUENCE_BYTES, WINDOW_BYTES
from gdp.message.bundle import BUNDLE_BYTES, Gathered, pack
from gdp.message.ledger import Ledger
from gdp.message.loss import Losses, LossReason
from gdp.message.move import MOVES_MAX, Move
from gdp.message.report import Report, ReportFlag
from gdp.message.status import Start, Status
from gdp.names import Name

__all__ = ["Publisher", "Secrets", "Source"]

_ALL: Final = 1 << 30
_BUNDLE: Final = int(Flag.BUNDLE)
_NEVER: Final = float("-inf")
_SETTLED_S: Final = 0.25  # after the last message of a best-effort topic, readers are told that it was the last


class Publisher:
    """Publishes one topic.

    Args:
        secrets: topic secrets by epoch; the newest seals.
        description: what a reader must know to understand the messages; travels sealed.
        depth: how many messages late joiners get (0: none).
        urgent: its frames go before those of other topics, wherever they queue.
        past: where the one that published the same before, in this life, ended.
        patience: with its readers.
    """

    def __init__(
        self,
        topic: Name,
        source: Source,
        secrets: Secrets,
        description: bytes,
        *,
        reliable: bool,
        depth: int = 0,
        urgent: bool = False,
        past: Past = FIRST,
        patience: Patience = TOPICS,
    ) -> None:
        if not secrets:
            raise LocalError("a publisher needs a topic secret")
        self.topic = topic
        self._source = source
        self._secrets = secrets
        self._statuses = Statuses(description, past.status_number)
        self._is_reliable = reliable
        self._repairs_wanted = reliable or depth > 0
        self.is_urgent = urgent
        self.has_more = False  # ``take`` came to its limit
        self.published: Callable[[Publisher], None] = lambda _: None  # called when something waits to be taken
        self._window = Kept(depth, past.next_number - 1, patience.lag_s)
        self._depth = depth
        self._flags = self._flags_now()
        self._epoch = max(secrets)
        self._former = (self._epoch, b"", _NEVER)  # the epoch before, its secret, and until when readers use it
        self._data = self._sealer(Kind.DATA)
        self._status = self._sealer(Kind.STATUS)
        self._next_number = past.next_number
        self.mtu: int | None = None  # smallest on the tree; unknown until one stands
        self._readers = Readers(topic, source, patience)
        self._moves: deque[Move] = deque(maxlen=MOVES_MAX)
        self.bundle_bytes = BUNDLE_BYTES  # 0: each message has a seal of its own
        self._gathered = Gathered()  # not sealed yet
        self._ledger = Ledger(past.sequence)
        self._unsent = Unsent()  # of a best-effort topic; the window has the others
        self._early = deque[tuple[int, bytes]]()  # latched messages from before the first reader, by sequence number
        self._sent_s = float("-inf")  # when data was last sent
        self.drops: Counter[DropReason] = Counter()
        self.payload_bytes = 0

    @property
    def readers(self) -> int:
        """Return how many readers have introduced themselves and are alive; none before a tree stands."""
        return 0 if self.mtu is None else len(self._readers)

    def is_followed_by(self, name: Name, now_s: float, awake_s: float) -> bool:
        """Return whether a tree stands, and a reader is heard and keeps up; ``awake_s``: since when we can hear."""
        keeps_up = self._window.has_reader(name) or not self._repairs_wanted
        return self.mtu is not None and keeps_up and self._readers.is_heard(name, now_s, awake_s)

    def is_read_by(self, name: Name) -> bool:
        """Return whether a tree stands, and somebody is a reader, keeping up or not."""
        return self.mtu is not None and name in self._readers

    @property
    def is_wanted(self) -> bool:
        """Return whether what is published now is for somebody: a reader, or one that may come back to its window."""
        return self.mtu is not None and bool(self._readers or (self._repairs_wanted and self._window.suspended))

    @property
    def confirms(self) -> bool:
        """Return whether readers confirm what they get: of a best-effort topic they do not."""
        return self._repairs_wanted

    @property
    def past(self) -> Past:
        """Return where it is, for another one that goes on with the same."""
        return Past(self._next_number, self._statuses.number, self._ledger.last)

    @property
    def messages(self) -> int:
        """Return how many messages were published here, those that no reader could get included."""
        return self._ledger.messages

    @property
    def losses(self) -> Losses:
        """Return which messages some reader did not get, as far as it is known here, and why."""
        return self._ledger.losses

    @property
    def repairs(self) -> int:
        """Return how many parts were sent again."""
        return self._window.repairs

    def has_room(self) -> bool:
        """Return whether a message may be published without pushing an unacknowledged one out."""
        return self._window.has_room() and self._gathered.held_bytes < WINDOW_BYTES

    def is_acknowledged(self) -> bool:
        """Return whether every reader has confirmed everything, those that may come back included."""
        return not (self._early or self._gathered or self._unsent) and self._window.is_acknowledged()

    @property
    def acknowledged(self) -> int:
        """Return how many messages every reader has confirmed; of a best-effort topic, how many were sent."""
        readings = self._readers.all() if self._repairs_wanted else []
        below = min([self._first_waiting(), *(each.sequence for each in readings)])
        lost = max((each.lost for each in readings), default=0)
        return min(self._ledger.confirmed(below), max(self.messages - lost, 0))

    def renew(self, secrets: Secrets, now_s: float) -> None:
        """Take the topic's secrets anew; messages from now on are sealed under the newest epoch.

        Readers are told by a status. For ``EPOCH_GRACE_S`` their notes may still be of the epoch before.

        Raises:
            LocalError: none.
        """
        if not secrets:
            raise LocalError("a publisher needs a topic secret")
        before = self._epoch, self._secrets[self._epoch]
        self._secrets = secrets
        if max(secrets) != self._epoch:
            self._former = (*before, now_s + EPOCH_GRACE_S)
            self._epoch = max(secrets)
            self._data = self._sealer(Kind.DATA)
            self._status = self._sealer(Kind.STATUS)
            self._statuses.wanted = True
            self.published(self)

    def describe(self, description: bytes) -> None:
        """Say from now on that messages are something else; who reads already is told at once.

        What is published right behind it may overtake the news, where a frame is lost.
        """
        if self._statuses.describe(description):
            self.published(self)

    def set_depth(self, depth: int) -> None:
        """Keep another number of messages for late joiners from now on; 0: none."""
        if depth == self._depth:
            return
        self._seal_gathered()
        self._depth = depth
        self._repairs_wanted = self._is_reliable or depth > 0
        self._flags = self._flags_now()
        self._window.keep(depth, self._next_number - 1)
        self.drops[DropReason.NO_READER] += self._let_early_go(depth)
        if not self._repairs_wanted:
            for name in self._readers.names():
                self._window.drop_reader(name)
        self._statuses.wanted = True
        self.published(self)

    def close(self) -> None:
        """Let go of all readers and of what waits for them; nothing is sent any more."""
        self.drops[DropReason.NO_READER] += len(self._gathered) + self._let_early_go(0)
        for reading in self._readers.all():
            self._ledger.give_up(reading.sequence, self._ledger.last)
        for name in self._readers.names():
            self._forget(name)
        self._gathered, self._unsent = Gathered(), Unsent()
        self.published(self)  # the last time: who waits for its frames finds none
        self.published = lambda _: None

    def tree_stands(self, mtu: int) -> bool:
        """Learn that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header).

        Returns:
            whether something has to be sealed anew for it.
        """
        self.mtu = max(mtu, MTU_MIN_BYTES)
        return self._split_anew(self.mtu)

    def publish(self, message: bytes) -> int | None:
        """Queue a message; return how many that makes, or None when nobody is there to read it.

        It is confirmed when ``acknowledged`` has come so far.

        Raises:
            LocalError: above the limits.
        """
        if not self.is_wanted:
            if self._depth:
                self._early.append((self._ledger.next(), message))
                self._let_early_go(self._depth)
            else:
                self.drops[DropReason.NO_READER] += 1
                self.skip(LossReason.NO_READER)
            return None
        self._queue_early()
        if self._depth or not self._gathered.is_small(message, self._bundle_room()):
            self._seal_gathered()
            self._queue(message, self._ledger.last + 1)
            self._ledger.next()
        else:
            self._gathered.add(self._ledger.next(), message)
            if self._gathered.held_bytes > (WINDOW_BYTES if self._readers else BUNDLE_BYTES):
                self._seal_next()
        self.payload_bytes += len(message)
        self.published(self)
        return self.messages

    def skip(self, reason: LossReason) -> None:
        """Count a message that is published to nobody: readers find it missing, and are told why."""
        self._seal_gathered()
        sequence = self._ledger.next()
        self._ledger.lose(sequence, sequence, reason)
        if self._readers:
            self._statuses.wanted = True
            self.published(self)

    def receive_introduction(self, header: Header, frame: bytes) -> None:
        """Take the sealed introduction of a reader, whose reports open from then on; what is wrong is counted."""
        try:
            if header.epoch != self._epoch:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(header.epoch))
            self._readers.introduce(header, frame, self._secrets[self._epoch])
        except RemoteError as error:
            self.drops[error.reason] += 1

    def receive_report(self, header: Header, frame: bytes, now_s: float) -> bool:
        """Take a reader's sealed report; return whether it is one. What is wrong with it is counted."""
        is_old = header.epoch != self._epoch
        try:
            secret = self._secret_of(header.epoch, now_s)
            report, is_new = self._readers.open(header, frame, secret, now_s, may_begin=not is_old)
        except RemoteError as error:
            self.drops[error.reason] += 1
            return False
        self._take_note(header.source, report, is_new=is_new, now_s=now_s)
        self._statuses.wanted |= is_old  # it has not heard yet of the new epoch
        return True

    def _secret_of(self, epoch: int, now_s: float) -> bytes:
        """Return the secret under which notes are taken now.

        Raises:
            EnvelopeError: UNKNOWN_EPOCH, none are.
        """
        if epoch == self._epoch:
            return self._secrets[epoch]
        former, secret, until_s = self._former
        if epoch != former or now_s >= until_s:
            raise EnvelopeError(DropReason.UNKNOWN_EPOCH, str(epoch))
        return secret

    def _take_note(self, name: bytes, report: Report, *, is_new: bool, now_s: float) -> None:
        reading, sequence = self._readers[name], min(report.sequence, self._ledger.last + 1)
        if is_new:
            self._let_go(name)
            reading.sequence = sequence or self._first_waiting()
        if ReportFlag.BYE in report.flags:
            self._forget(name)
            if not self._readers.all():
                self._ledger.give_up(max(sequence, reading.sequence), self._ledger.last, LossReason.NO_READER)
            return
        report = self._follow_moves(report)
        if ReportFlag.NEW in report.flags:
            self._welcome(name, report, now_s)
            return
        reading.start = None
        if self._repairs_wanted:
            self._take_report(name, report, is_new=is_new, now_s=now_s)
        if not self._window.is_suspended(name):
            reading.behind_s = None
        reading.sequence, reading.lost = max(reading.sequence, sequence), max(reading.lost, report.lost)
        sent, (sequence, _) = self._sent(), self._places()
        is_settled = self._repairs_wanted or now_s - self._sent_s > _SETTLED_S
        if report.sequence < sequence and is_settled and (report.next_number >= sent[0] or not self._repairs_wanted):
            self._statuses.wanted = True  # it does not know what it has lost behind the last message that it has

    def timeout(self, now_s: float) -> None:
        """Suspend silent readers, let laggards hold nothing, and ask those that owe a report."""
        for name in self._readers.silent(now_s):
            self._window.suspend(name)
            self._readers.suspend(name, now_s)
            self._statuses.starts.pop(name, None)
        for name in self._window.laggards(now_s):
            if self._readers.is_quiet(name, now_s):
                self._window.suspend(name)
                self._readers[name].behind_s = now_s
            else:
                self._readers.do_penance(name, now_s)
                self._window.drop_reader(name)
                self._statuses.wanted = True
        for name, reading in self._readers.overdue(now_s):
            self._give_up(name, reading, now_s)
        self._statuses.wanted |= self._window.probe_due(now_s)
        self._statuses.timeout(now_s)

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._window.next_probe(), self._window.next_laggard(), self._readers.next_silent()]
        if self._readers and self.mtu is not None:
            times.append(self._statuses.next_timeout())
        return min((time for time in times if time is not None), default=None)

    def take(self, now_s: float, limit_bytes: int = _ALL) -> list[bytes]:
        """Return frames that may go now, about ``limit_bytes`` at a time: the rest is sealed when it is asked for."""
        self.has_more = False
        if self.mtu is None or not self._readers:
            return []
        self._queue_early()
        limit = max(limit_bytes // self.mtu, 1)
        frames = self._seal_status(now_s) if self._statuses.is_due(now_s) else []
        frames += self._unsent.take(max(limit - len(frames), 1))
        frames += self._window.take(now_s, max(limit - len(frames), 1))
        while self._gathered and len(frames) < limit and not self._has_unsent():
            self._seal_next()
            left = limit - len(frames)
            frames += self._window.take(now_s, left) if self._repairs_wanted else self._unsent.take(left)
        self.has_more = len(frames) >= limit
        self._sent_s = now_s if frames else self._sent_s
        return frames

    def _has_unsent(self) -> bool:
        return self._window.sent[0] < self._next_number if self._repairs_wanted else bool(self._unsent)

    def _bundle_room(self) -> int:
        """Return how large a bundle may be: one frame of a best-effort topic, which loses all of it with one part."""
        if self._repairs_wanted or self.mtu is None:
            return self.bundle_bytes
        return min(self.bundle_bytes, part_room(self.mtu) - SIGNATURE_BYTES - SEQUENCE_BYTES)

    def _seal_next(self) -> None:
        """Seal of what was gathered as much as goes together."""
        first, together = self._gathered.first, self._gathered.take(self._bundle_room())
        self._queue(together[0] if len(together) == 1 else pack(together), first, len(together))

    def _seal_gathered(self) -> None:
        while self._gathered:
            self._seal_next()

    def _queue(self, body: bytes, sequence: int, messages: int = 1) -> None:
        """Number and seal a message, or a bundle of several; what is too much of all that waits goes, oldest first."""
        assert self.mtu is not None
        number, ledger = self._next_number, self._ledger
        frames = self._seal(number, _with_sequence(sequence, body), self.mtu, is_bundle=messages > 1)
        self._next_number += 1
        if not self._repairs_wanted:
            for gone in self._unsent.add(frames, Carried(number, sequence, messages)):
                self.drops[DropReason.MEMORY_FULL] += gone.messages
                ledger.lose(gone.sequence, gone.sequence + gone.messages - 1, LossReason.QUEUE_OVERFLOW)
            return
        ledger.put(number, sequence, messages)
        let_go = self._window.add(number, frames, frames.size_bytes)
        self.drops[DropReason.MEMORY_FULL] += ledger.let_go(let_go, LossReason.WINDOW_OVERFLOW)
        ledger.forget(self._oldest())

    def _oldest(self) -> int:
        """Return the first number that is kept, or will be."""
        oldest = self._window.oldest
        return self._next_number if oldest is None else oldest

    def _first_waiting(self) -> int:
        """Return the first sequence number that waits for its message number, or will."""
        if self._early:
            return self._early[0][0]
        return self._gathered.first if self._gathered else self._ledger.last + 1

    def _let_early_go(self, keep: int) -> int:
        """Keep so many latched messages for the first reader; return how many went."""
        gone = max(len(self._early) - keep, 0)
        for _ in range(gone):
            sequence, _ = self._early.popleft()
            self._ledger.lose(sequence, sequence, LossReason.NO_READER)
        return gone

    def _queue_early(self) -> None:
        while self._early:
            sequence, message = self._early.popleft()
            self._queue(message, sequence)

    def _seal(self, number: int, body: bytes | Sealed, mtu: int, *, is_bundle: bool) -> Sealed:
        return self._data.seal(number, self._flags | _BUNDLE * is_bundle, body, mtu)

    def _split_anew(self, mtu: int) -> bool:
        """Seal anew what has become too large for its path; return whether there is any."""
        unsent = self._unsent.take_back(mtu)
        for body, carried in unsent:
            self._queue(body, carried.sequence, carried.messages)
        kept = [(number, each) for number, each in self._window.kept() if isinstance(each, Sealed)]
        if not any(each.largest > mtu for _, each in kept):
            return bool(unsent)
        first, end = kept[0][0], self._next_number
        move = Move(first, end - first, end + 1)
        is_bundle = self._ledger.is_bundle
        moved = [
            (move.of(number), self._seal(move.of(number), each, mtu, is_bundle=is_bundle(number)))
            for number, each in kept
        ]
        self._ledger.forget(first)
        self._ledger.move(move)
        self._next_number = move.of(end)
        self._moves.append(move)
        self._window.move(move, [(number, each, each.size_bytes) for number, each in moved])
        starts = self._statuses.starts
        for name, start in starts.items():
            starts[name] = start._replace(number=move.of(start.number))
        for reader in self._readers.all():
            if reader.start is not None:
                reader.start = reader.start._replace(number=move.of(reader.start.number))
        self._statuses.wanted = True
        return True

    def _follow_moves(self, report: Report) -> Report:
        """Return a report as it would be under the present numbers; a reader that does not know them is told."""
        for move in self._moves:
            if move.is_before(report.next_number):
                report = report._replace(next_number=move.of(report.next_number), next_part=0, missing=())
                self._statuses.wanted = True
        return report

    def _sealer(self, kind: Kind) -> Sealer:
        source, secret = self._source, self._secrets[self._epoch]
        return Sealer(
            secret, self._epoch, kind, source.name, source.incarnation, self.topic, source.signer, source.random_bytes
        )

    def _forget(self, name: bytes) -> None:
        if self._readers.forget(name):
            self._let_go(name)

    def _let_go(self, name: bytes) -> None:
        self._statuses.starts.pop(name, None)
        self._window.drop_reader(name)

    def _give_up(self, name: bytes, reading: Reading, now_s: float) -> None:
        """Keep nothing any more for a reader whose window has been suspended for too long."""
        self._seal_gathered()  # it is given up, too
        self._ledger.give_up(reading.sequence, self._ledger.last)
        if self._readers.is_suspended(name):
            self._forget(name)
        else:  # it is heard again, and cannot catch up
            self._window.drop_reader(name)
            self._readers.do_penance(name, now_s)
            reading.behind_s = None
        self._statuses.wanted = True

    def _welcome(self, name: bytes, report: Report, now_s: float) -> None:
        """Give a new reader its first message; one that asks again gets the same answer."""
        reader = self._readers[name]
        if name not in self._statuses.starts and not self._statuses.is_full:
            self._seal_gathered()  # it was published before this reader came
            oldest = self._window.oldest
            is_gone = oldest is not None and reader.start is not None and reader.start.number < oldest
            if reader.start is None or is_gone or not self._repairs_wanted:
                number = self._first_of(report)
                begin = self._ledger.begin_of(number, self._first_waiting())
                reader.start = Start(reader.incarnation, number, begin, reader.confirmed)
                reader.sequence = min(report.sequence, self._ledger.last + 1) or begin
                if self._repairs_wanted and now_s >= reader.out_until_s:
                    self._window.add_reader(name, number, now_s)
                    if number < self._next_number and report.next_number and self._window.readers > 1:
                        self._window.suspend(name)  # the others are not to wait for what it missed
                        reader.behind_s = now_s
            self._statuses.starts[name] = reader.start
        self._statuses.wanted = True

    def _first_of(self, report: Report) -> int:
        """Return the message number at which a reader begins: where it was before, or with what is new."""
        oldest = self._oldest()
        if report.next_number and self._repairs_wanted:
            return min(max(report.next_number, oldest), self._next_number)
        if not self._depth:
            return self._next_number
        return max(oldest, self._next_number + len(self._early) - self._depth)

    def _take_report(self, name: bytes, report: Report, *, is_new: bool, now_s: float) -> None:
        reader, window = self._readers[name], self._window
        oldest = self._oldest()
        if not (window.has_reader(name) or window.is_suspended(name)) and now_s >= reader.out_until_s:
            if not is_new and report.next_number < oldest:  # it lagged; one that was forgotten was given up before
                end = self._ledger.begin_of(oldest, self._first_waiting())
                self._ledger.give_up(report.sequence, end - 1)
            window.add_reader(name, min(max(report.next_number, oldest), self._next_number), now_s)
        if window.has_reader(name) or window.is_suspended(name):
            window.report(name, report, now_s)
        is_gone = report.next_number < oldest if is_new else report.missing and report.missing[0].number < oldest
        if is_gone or (window.is_suspended(name) and not report.missing):
            self._statuses.wanted = True  # it asks for what is gone, or does not know what it lacks

    def _flags_now(self) -> int:
        wanted = (self._is_reliable, Flag.RELIABLE), (self._depth, Flag.LATCHED), (self.is_urgent, Flag.URGENT)
        return sum(int(flag) for is_set, flag in wanted if is_set)

    def _seal_status(self, now_s: float) -> list[bytes]:
        assert self.mtu is not None
        oldest, sent = self._window.oldest, self._sent()
        sent_sequence, oldest_sequence = self._places()
        place = Status(
            sent[0] if oldest is None else oldest, *sent, {}, b"", tuple(self._moves),
            oldest_sequence, sent_sequence, tuple(self._ledger.gone),
        )  # fmt: skip
        wire = self._statuses.take(place, now_s)
        return list(self._status.seal(self._statuses.number, self._flags, wire, self.mtu))

    def _sent(self) -> tuple[int, int]:
        """Return the message number and the part before which everything has been sent."""
        if self._repairs_wanted:
            return self._window.sent
        unsent = self._unsent.oldest
        return (self._next_number if unsent is None else unsent.number), 0

    def _places(self) -> tuple[int, int]:
        """Return the sequence numbers at what is sent next, and at what is kept first."""
        unsent, oldest = self._unsent.oldest, self._window.oldest
        if not self._repairs_wanted:
            sent = self._first_waiting() if unsent is None else unsent.sequence
        else:
            sent = self._ledger.begin_of(self._window.sent[0], self._first_waiting())
        return sent, sent if oldest is None else self._ledger.begin_of(oldest, sent)


def _with_sequence(sequence: int, body: bytes) -> bytes:
    return sequence.to_bytes(SEQUENCE_BYTES, "big") + body
