"""One topic as its publisher sees it: number, seal, keep, pace, repair.

Place: pure; time comes in as ``now_s`` (monotonic seconds). Frames come out of ``take`` and go to the switch.

A small message waits until frames are asked for, and those that wait together become one bundle, sealed and signed once
(``gdp/message/bundle.py``); not of a latched topic, whose late joiners get so many messages and no more.

A message is sealed once. Where the path has become too narrow for what is kept, that is split anew, and all that is
kept moves to new numbers; statuses say which (``gdp/message/move.py``). Without a reader nothing is sealed; the last
``depth`` messages of a latched topic wait for late joiners.

A reader is known by its notes. One that falls silent is forgotten; one that stands still, or lags while others are
through, holds the window no longer: it gets what is sent, and is told to skip what is gone, until after a penance it
may hold the window again.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from gdp.client.best_effort import Unsent
from gdp.client.kept import Kept
from gdp.client.pasts import FIRST, Past
from gdp.client.readers import TOPICS, Patience, Readers
from gdp.client.source import Secrets, Source
from gdp.client.statuses import Statuses
from gdp.crypto.envelope import SIGNATURE_BYTES, Sealed, Sealer, part_room
from gdp.errors import DropReason, LocalError, RemoteError
from gdp.frame.codec import Header
from gdp.frame.kinds import Flag, Kind
from gdp.limits import MTU_MIN_BYTES, WINDOW_BYTES
from gdp.message.bundle import BUNDLE_BYTES, Counts, Gathered, pack
from gdp.message.move import MOVES_MAX, Move
from gdp.message.report import Report, ReportFlag
from gdp.names import Name

__all__ = ["Publisher", "Secrets", "Source"]

_ALL: Final = 1 << 30
_BUNDLE: Final = int(Flag.BUNDLE)


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
        self._data = self._sealer(Kind.DATA)
        self._status = self._sealer(Kind.STATUS)
        self._next_number = past.next_number
        self.mtu: int | None = None  # smallest on the tree; unknown until one stands
        self._readers = Readers(topic, source, patience)
        self._moves: deque[Move] = deque(maxlen=MOVES_MAX)
        self._skipped = past.next_number - 1  # numbers that its past used, or that moves left behind
        self.bundle_bytes = BUNDLE_BYTES  # 0: each message has a seal of its own
        self._gathered = Gathered()  # not sealed yet
        self._counts = Counts()
        self._unsent = Unsent()  # of a best-effort topic; the window has the others
        self._early = deque[bytes](maxlen=depth or None)  # latched messages from before the first reader
        self.drops: Counter[DropReason] = Counter()
        self.messages = 0
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
    def past(self) -> Past:
        """Return where it is, for another one that goes on with the same."""
        return Past(self._next_number, self._statuses.number)

    @property
    def repairs(self) -> int:
        """Return how many parts were sent again."""
        return self._window.repairs

    def has_room(self) -> bool:
        """Return whether a message may be published without pushing an unacknowledged one out."""
        return self._window.has_room() and self._gathered.held_bytes < WINDOW_BYTES

    def is_acknowledged(self) -> bool:
        """Return whether every reader has confirmed everything."""
        return not (self._early or self._gathered or self._unsent) and self._window.is_acknowledged()

    @property
    def acknowledged(self) -> int:
        """Return how many messages every reader has confirmed; of a best-effort topic, how many were sent."""
        if not self._repairs_wanted:
            return self.messages
        number = self._window.acknowledged
        return number - self._skipped + self._counts.beyond_one(number)

    def renew(self, secrets: Secrets) -> None:
        """Take the topic's secrets anew; messages from now on are sealed under the newest epoch.

        Raises:
            LocalError: none.
        """
        if not secrets:
            raise LocalError("a publisher needs a topic secret")
        self._secrets = secrets
        if max(secrets) != self._epoch:
            self._epoch = max(secrets)
            self._data = self._sealer(Kind.DATA)
            self._status = self._sealer(Kind.STATUS)

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
        early = self._early
        self._early = deque(early if depth else (), maxlen=depth or None)
        self.drops[DropReason.NO_READER] += len(early) - len(self._early)
        if not self._repairs_wanted:
            for name in self._readers:
                self._window.drop_reader(name)
        self._statuses.wanted = True
        self.published(self)

    def close(self) -> None:
        """Let go of all readers and of what waits for them; nothing is sent any more."""
        self.drops[DropReason.NO_READER] += len(self._early) + len(self._gathered)
        for name in self._readers:
            self._forget(name)
        self._early.clear()
        self._gathered, self._unsent = Gathered(), Unsent()
        self.published(self)  # the last time: who waits for its frames finds none
        self.published = lambda _: None

    def tree_stands(self, mtu: int) -> None:
        """Learn that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header)."""
        self.mtu = max(mtu, MTU_MIN_BYTES)
        self._split_anew(self.mtu)

    def publish(self, message: bytes) -> int | None:
        """Queue a message; return how many that makes, or None when nobody is there to read it.

        It is confirmed when ``acknowledged`` has come so far.

        Raises:
            LocalError: above the limits.
        """
        if self.mtu is None or not self._readers:
            if self._depth:
                self._early.append(message)
            else:
                self.drops[DropReason.NO_READER] += 1
            return None
        if self._depth or not self._gathered.is_small(message, self._bundle_room()):
            self._seal_gathered()
            self._queue(message)
        else:
            self._gathered.add(message)
            if self._gathered.held_bytes > WINDOW_BYTES:
                self._seal_next()
        self.messages += 1
        self.payload_bytes += len(message)
        self.published(self)
        return self.messages

    def receive_report(self, header: Header, frame: bytes, now_s: float) -> None:
        """Take a reader's sealed report; what is wrong with it is counted."""
        try:
            report, is_new = self._readers.open(header, frame, self._secrets, now_s)
        except RemoteError as error:
            self.drops[error.reason] += 1
            return
        name = header.source
        if is_new:
            self._let_go(name)
        if ReportFlag.BYE in report.flags:
            self._forget(name)
        elif ReportFlag.NEW in report.flags:
            self._welcome(name, now_s)
        else:
            self._readers[name].start = None
            if self._repairs_wanted:
                self._take_report(name, self._follow_moves(report), now_s)

    def timeout(self, now_s: float) -> None:
        """Let silent readers go, let laggards hold nothing, and ask those that owe a report."""
        for name in self._readers.silent(now_s):
            self._forget(name)
        for name in self._window.laggards(now_s):
            self._readers.do_penance(name, now_s)
            self._window.drop_reader(name)
            self._statuses.wanted = True
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
        while self._early:
            self.publish(self._early.popleft())
        limit = max(limit_bytes // self.mtu, 1)
        frames = self._seal_status(now_s) if self._statuses.is_due(now_s) else []
        frames += self._unsent.take(max(limit - len(frames), 1))
        frames += self._window.take(now_s, max(limit - len(frames), 1))
        while self._gathered and len(frames) < limit and not self._has_unsent():
            self._seal_next()
            left = limit - len(frames)
            frames += self._window.take(now_s, left) if self._repairs_wanted else self._unsent.take(left)
        self.has_more = len(frames) >= limit
        return frames

    def _has_unsent(self) -> bool:
        return self._window.sent[0] < self._next_number if self._repairs_wanted else bool(self._unsent)

    def _bundle_room(self) -> int:
        """Return how large a bundle may be: one frame of a best-effort topic, which loses all of it with one part."""
        if self._repairs_wanted or self.mtu is None:
            return self.bundle_bytes
        return min(self.bundle_bytes, part_room(self.mtu) - SIGNATURE_BYTES)

    def _seal_next(self) -> None:
        """Seal of what was gathered as much as goes together."""
        together = self._gathered.take(self._bundle_room())
        self._queue(together[0] if len(together) == 1 else pack(together), len(together))

    def _seal_gathered(self) -> None:
        while self._gathered:
            self._seal_next()

    def _queue(self, body: bytes, messages: int = 1) -> None:
        """Number and seal a message, or a bundle of several; what is too much of all that waits goes, oldest first."""
        assert self.mtu is not None
        number = self._next_number
        frames = self._seal(number, body, self.mtu, is_bundle=messages > 1)
        self._next_number += 1
        if not self._repairs_wanted:
            self.drops[DropReason.MEMORY_FULL] += self._unsent.add(frames, messages)
            return
        self._counts.forget(self._oldest())
        self._counts.note(number, messages)
        let_go = self._window.let_go
        self._window.add(number, frames, frames.size_bytes)
        gone = self._window.let_go - let_go
        self.drops[DropReason.MEMORY_FULL] += gone + self._counts.forget(self._oldest())

    def _oldest(self) -> int:
        """Return the first number that is kept, or will be."""
        oldest = self._window.oldest
        return self._next_number if oldest is None else oldest

    def _seal(self, number: int, body: bytes, mtu: int, *, is_bundle: bool) -> Sealed:
        return self._data.seal(number, self._flags | _BUNDLE * is_bundle, body, mtu)

    def _split_anew(self, mtu: int) -> None:
        """Seal anew what has become too large for its path."""
        for body, messages in self._unsent.take_back(mtu):
            self._queue(body, messages)
        kept = [(number, each) for number, each in self._window.kept() if isinstance(each, Sealed)]
        if not any(each.largest > mtu for _, each in kept):
            return
        first, end = kept[0][0], self._next_number
        move = Move(first, end - first, end + 1)
        moved = [
            (move.of(number), self._seal(move.of(number), each.message(), mtu, is_bundle=number in self._counts))
            for number, each in kept
        ]
        self._counts.forget(first)
        self._counts.move(move)
        self._next_number = move.of(end)
        self._skipped += move.to - first
        self._moves.append(move)
        self._window.move(move, [(number, each, each.size_bytes) for number, each in moved])
        self._statuses.starts = {name: move.of(start) for name, start in self._statuses.starts.items()}
        for reader in self._readers.readings():
            if reader.start is not None:
                reader.start = move.of(reader.start)
        self._statuses.wanted = True

    def _follow_moves(self, report: Report) -> Report:
        """Return a report as it would be under the present numbers; a reader that does not know them is told."""
        for move in self._moves:
            if move.is_before(report.next_number):
                report = Report(report.flags, move.of(report.next_number), 0, ())
                self._statuses.wanted = True
        return report

    def _sealer(self, kind: Kind) -> Sealer:
        source, secret = self._source, self._secrets[self._epoch]
        return Sealer(secret, self._epoch, kind, source.name, source.incarnation, self.topic, source.signer)

    def _forget(self, name: bytes) -> None:
        if self._readers.forget(name):
            self._let_go(name)

    def _let_go(self, name: bytes) -> None:
        self._statuses.starts.pop(name, None)
        self._window.drop_reader(name)

    def _welcome(self, name: bytes, now_s: float) -> None:
        """Give a new reader its first message; one that asks again gets the same answer."""
        reader = self._readers[name]
        if name not in self._statuses.starts and not self._statuses.is_full:
            self._seal_gathered()  # it was published before this reader came
            oldest = self._window.oldest
            is_gone = oldest is not None and reader.start is not None and reader.start < oldest
            if reader.start is None or is_gone or not self._repairs_wanted:
                reader.start = self._next_number
                if self._depth and oldest is not None:
                    reader.start = max(oldest, self._next_number + len(self._early) - self._depth)
                if self._repairs_wanted and now_s >= reader.out_until_s:
                    self._window.add_reader(name, reader.start, now_s)
            self._statuses.starts[name] = reader.start
        self._statuses.wanted = True

    def _take_report(self, name: bytes, report: Report, now_s: float) -> None:
        reader, window = self._readers[name], self._window
        oldest = window.oldest
        if not window.has_reader(name) and now_s >= reader.out_until_s:  # it was gone, or lagged
            first = report.next_number if oldest is None else max(report.next_number, oldest)
            window.add_reader(name, min(first, self._next_number), now_s)
        if window.has_reader(name):
            window.report(name, report, now_s)
        if report.missing and (oldest is None or report.missing[0].number < oldest):
            self._statuses.wanted = True  # it asks for what is gone

    def _flags_now(self) -> int:
        wanted = (self._is_reliable, Flag.RELIABLE), (self._depth, Flag.LATCHED), (self.is_urgent, Flag.URGENT)
        return sum(int(flag) for is_set, flag in wanted if is_set)

    def _seal_status(self, now_s: float) -> list[bytes]:
        assert self.mtu is not None
        oldest = self._window.oldest
        sent = self._window.sent if self._repairs_wanted else (self._next_number, 0)
        wire = self._statuses.take(sent[0] if oldest is None else oldest, sent, self._moves, now_s)
        return list(self._status.seal(self._statuses.number, self._flags, wire, self.mtu))
