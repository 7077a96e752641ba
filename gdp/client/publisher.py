"""One topic as its publisher sees it: number, seal, keep, pace, repair.

Place: pure; time comes in as ``now_s`` (monotonic seconds). Frames come out of ``take`` and go to the switch.

A message is sealed once. Where the path has become too narrow for what is kept, that is split anew, and all that is
kept moves to new numbers; statuses say which (``gdp/message/move.py``). Without a reader nothing is sealed; the last
``depth`` messages of a latched topic wait for late joiners.

A reader is known by its notes. One that falls silent is forgotten; one that stands still, or lags while others are
through, holds the window no longer: it gets what is sent, and is told to skip what is gone, until after a penance it
may hold the window again.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gdp.crypto.envelope import Sealed, Sealer, Signer
from gdp.crypto.note import NoteOpener
from gdp.errors import DropReason, EnvelopeError, FrameError, LocalError, RemoteError
from gdp.frame.codec import Header
from gdp.frame.kinds import Flag, Kind
from gdp.limits import MTU_MIN_BYTES, READER_LEASE_S, WINDOW_BYTES
from gdp.message.move import MOVES_MAX, Move
from gdp.message.report import Report, ReportFlag
from gdp.message.status import STARTS_MAX, Status
from gdp.message.window import SendWindow
from gdp.names import Name

__all__ = ["Publisher", "Secrets", "Source"]

_READERS_MAX: Final = 1_024
_ALL: Final = 1 << 30
_LIVES_MAX: Final = 4_096  # incarnations of readers whose old notes are known as such
_STATUS_GAP_S: Final = 0.02  # between two statuses
_STATUS_BYTES_PER_S: Final = 8 << 20  # ... and longer after a large one
_PENANCE_MIN_S: Final = 2 * READER_LEASE_S
_PENANCE_MAX_S: Final = 16 * READER_LEASE_S

Secrets = Mapping[int, bytes]  # key epoch -> topic secret, 32 bytes


@dataclass(frozen=True, slots=True)
class Source:
    """Who publishes, in this life of its process."""

    name: Name
    incarnation: int
    signer: Signer


@dataclass(slots=True)
class _Reader:
    incarnation: int
    heard_s: float
    start: int | None = None  # its first message; None once it has begun to confirm
    out_until_s: float = 0.0  # it may not hold the window before
    penance_s: float = _PENANCE_MIN_S


class Publisher:
    """Publishes one topic.

    Args:
        secrets: topic secrets by epoch; the newest seals.
        description: what a reader must know to understand the messages; travels sealed.
        depth: how many messages late joiners get (0: none).
        urgent: its frames go before those of other topics, wherever they queue.
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
    ) -> None:
        if not secrets:
            raise LocalError("a publisher needs a topic secret")
        self.topic = topic
        self._source = source
        self._secrets = secrets
        self._description = description
        self._repairs_wanted = reliable or depth > 0
        self.has_new = False  # something was published since ``take`` was last asked
        wanted = (reliable, Flag.RELIABLE), (depth, Flag.LATCHED), (urgent, Flag.URGENT)
        self._flags = sum(int(flag) for is_set, flag in wanted if is_set)
        self._window = SendWindow(depth)
        self._depth = depth
        self._epoch = max(secrets)
        self._data = self._sealer(Kind.DATA)
        self._status = self._sealer(Kind.STATUS)
        self._next_number = 1
        self._status_number = 0
        self._mtu: int | None = None  # unknown until a tree stands
        self._readers: dict[bytes, _Reader] = {}
        self._lives: OrderedDict[tuple[bytes, int, int], NoteOpener] = OrderedDict()
        self._starts: dict[bytes, int] = {}
        self._status_wanted = False
        self._status_at_s = float("-inf")  # when the next one may go
        self._moves: deque[Move] = deque(maxlen=MOVES_MAX)
        self._skipped = 0  # numbers that moves left behind
        self._waiting = deque[Sealed]()  # best-effort messages
        self._waiting_bytes = 0
        self._waiting_part = 0  # of the oldest: the first that has not left
        self._early = deque[bytes](maxlen=depth or None)  # latched messages from before the first reader
        self.drops: Counter[DropReason] = Counter()
        self.messages = 0
        self.payload_bytes = 0

    @property
    def readers(self) -> int:
        """Return how many readers have introduced themselves and are alive; none before a tree stands."""
        return 0 if self._mtu is None else len(self._readers)

    @property
    def repairs(self) -> int:
        """Return how many parts were sent again."""
        return self._window.repairs

    def has_room(self) -> bool:
        """Return whether a message may be published without pushing an unacknowledged one out."""
        return self._window.has_room()

    def is_acknowledged(self) -> bool:
        """Return whether every reader has confirmed everything."""
        return not self._early and not self._waiting and self._window.is_acknowledged()

    @property
    def acknowledged(self) -> int:
        """Return how many messages every reader has confirmed; of a best-effort topic, how many were sent."""
        return self._window.acknowledged - self._skipped if self._repairs_wanted else self.messages

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

    def tree_stands(self, mtu: int) -> None:
        """Learn that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header)."""
        self._mtu = max(mtu, MTU_MIN_BYTES)
        self._split_anew(self._mtu)

    def publish(self, message: bytes) -> int | None:
        """Seal and queue a message; return its number, or None when nobody is there to read it.

        Raises:
            LocalError: above the limits.
        """
        self.has_new = True
        if self._mtu is None or not self._readers:
            if self._depth:
                self._early.append(message)
            else:
                self.drops[DropReason.NO_READER] += 1
            return None
        number = self._next_number
        frames = self._seal(message, self._mtu)
        self.messages += 1
        self.payload_bytes += len(message)
        if self._repairs_wanted:
            let_go = self._window.let_go
            self._window.add(number, frames, frames.size_bytes)
            self.drops[DropReason.MEMORY_FULL] += self._window.let_go - let_go
        else:
            self._wait(frames)
        return number

    def receive_report(self, header: Header, frame: bytes, now_s: float) -> None:
        """Take a reader's sealed report; what is wrong with it is counted."""
        try:
            report = self._open_report(header, frame, now_s)
        except RemoteError as error:
            self.drops[error.reason] += 1
            return
        name = header.source
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
        for name in [name for name, reader in self._readers.items() if now_s - reader.heard_s > READER_LEASE_S]:
            self._forget(name)
        for name in self._window.laggards(now_s):
            reader = self._readers[name]
            reader.out_until_s = now_s + reader.penance_s
            reader.penance_s = min(2 * reader.penance_s, _PENANCE_MAX_S)
            self._window.drop_reader(name)
            self._status_wanted = True
        if self._window.probe_due(now_s):
            self._status_wanted = True

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        lease = min((reader.heard_s for reader in self._readers.values()), default=None)
        times = [self._window.next_probe(), None if lease is None else lease + READER_LEASE_S + 0.001]
        if self._status_wanted and self._readers and self._mtu is not None:
            times.append(self._status_at_s)
        return min((time for time in times if time is not None), default=None)

    def take(self, now_s: float, limit_bytes: int = _ALL) -> list[bytes]:
        """Return frames that may go now, about ``limit_bytes`` at a time: the rest is sealed when it is asked for."""
        self.has_new = False
        if self._mtu is None or not self._readers:
            return []
        while self._early:
            self.publish(self._early.popleft())
        limit = max(limit_bytes // self._mtu, 1)
        frames = self._take_waiting(limit)
        if self._status_wanted and now_s >= self._status_at_s:
            frames += self._seal_status(now_s)
        return frames + self._window.take(now_s, max(limit - len(frames), 1))

    def _seal(self, message: bytes, mtu: int) -> Sealed:
        number = self._next_number
        self._next_number += 1
        return self._data.seal(number, self._flags, message, mtu)

    def _split_anew(self, mtu: int) -> None:
        """Seal anew what has become too large for its path."""
        if any(each.largest > mtu for each in self._waiting):
            waiting = [each.message() for each in self._waiting]
            self._waiting.clear()
            self._waiting_bytes = self._waiting_part = 0
            for message in waiting:
                self._wait(self._seal(message, mtu))
        kept = [(number, each) for number, each in self._window.kept() if isinstance(each, Sealed)]
        if not any(each.largest > mtu for _, each in kept):
            return
        first, end = kept[0][0], self._next_number
        move = Move(first, end - first, end + 1)
        moved = [
            (move.of(number), self._data.seal(move.of(number), self._flags, each.message(), mtu))
            for number, each in kept
        ]
        self._next_number = move.of(end)
        self._skipped += move.to - first
        self._moves.append(move)
        self._window.move(move, [(number, each, each.size_bytes) for number, each in moved])
        self._starts = {name: move.of(start) for name, start in self._starts.items()}
        for reader in self._readers.values():
            if reader.start is not None:
                reader.start = move.of(reader.start)
        self._status_wanted = True

    def _follow_moves(self, report: Report) -> Report:
        """Return a report as it would be under the present numbers; a reader that does not know them is told."""
        for move in self._moves:
            if move.is_before(report.next_number):
                report = Report(report.flags, move.of(report.next_number), 0, ())
                self._status_wanted = True
        return report

    def _sealer(self, kind: Kind) -> Sealer:
        source = self._source
        secret = self._secrets[self._epoch]
        return Sealer(secret, self._epoch, kind, source.name, source.incarnation, self.topic, source.signer)

    def _open_report(self, header: Header, frame: bytes, now_s: float) -> Report:
        name, life = header.source, (header.source, header.incarnation, header.epoch)
        opener = self._lives.get(life)
        is_known = opener is not None
        if opener is None:
            secret = self._secrets.get(header.epoch)
            if secret is None:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH)
            source = self._source
            opener = NoteOpener(
                secret, Kind.REPORT, name, header.incarnation, source.name, self.topic, source.incarnation
            )
        report = Report.from_wire(opener.open(header, frame))
        reader = self._readers.get(name)
        if reader is None and len(self._readers) >= _READERS_MAX:
            raise EnvelopeError(DropReason.QUOTA, "readers")
        is_current = is_known if reader is None else reader.incarnation == header.incarnation
        if not is_current and ReportFlag.NEW not in report.flags:
            raise FrameError(DropReason.UNKNOWN_SENDER, "a report of a life that never began, or is over")
        self._lives[life] = opener
        self._lives.move_to_end(life)
        if len(self._lives) > _LIVES_MAX:
            self._lives.popitem(last=False)
        if reader is None or reader.incarnation != header.incarnation:
            self._forget(name)
            reader = self._readers[name] = _Reader(header.incarnation, now_s)
        reader.heard_s = now_s
        return report

    def _forget(self, name: bytes) -> None:
        if self._readers.pop(name, None) is not None:
            self._starts.pop(name, None)
            self._window.drop_reader(name)

    def _welcome(self, name: bytes, now_s: float) -> None:
        """Give a new reader its first message; one that asks again gets the same answer."""
        reader = self._readers[name]
        if name not in self._starts and len(self._starts) < STARTS_MAX:
            oldest = self._window.oldest
            is_gone = oldest is not None and reader.start is not None and reader.start < oldest
            if reader.start is None or is_gone or not self._repairs_wanted:
                reader.start = self._next_number
                if self._depth and oldest is not None:
                    reader.start = max(oldest, self._next_number + len(self._early) - self._depth)
                if self._repairs_wanted and now_s >= reader.out_until_s:
                    self._window.add_reader(name, reader.start, now_s)
            self._starts[name] = reader.start
        self._status_wanted = True

    def _take_report(self, name: bytes, report: Report, now_s: float) -> None:
        reader, window = self._readers[name], self._window
        oldest = window.oldest
        if not window.has_reader(name) and now_s >= reader.out_until_s:  # it was gone, or lagged
            first = report.next_number if oldest is None else max(report.next_number, oldest)
            window.add_reader(name, min(first, self._next_number), now_s)
        if window.has_reader(name):
            window.report(name, report, now_s)
        if report.missing and (oldest is None or report.missing[0].number < oldest):
            self._status_wanted = True  # it asks for what is gone

    def _wait(self, frames: Sealed) -> None:
        """Queue a best-effort message; the oldest go when nobody takes them."""
        self._waiting.append(frames)
        self._waiting_bytes += frames.size_bytes
        while self._waiting_bytes > WINDOW_BYTES and len(self._waiting) > 1:
            self._let_oldest_go()
            self.drops[DropReason.MEMORY_FULL] += 1

    def _take_waiting(self, limit: int) -> list[bytes]:
        """Return at most so many frames of best-effort messages, in order, sealed as they are taken."""
        frames: list[bytes] = []
        while self._waiting and len(frames) < limit:
            oldest, first = self._waiting[0], self._waiting_part
            taken = oldest[first : first + limit - len(frames)]
            frames += taken
            self._waiting_part += len(taken)
            if self._waiting_part == len(oldest):
                self._let_oldest_go()
        return frames

    def _let_oldest_go(self) -> None:
        self._waiting_bytes -= self._waiting.popleft().size_bytes
        self._waiting_part = 0

    def _seal_status(self, now_s: float) -> list[bytes]:
        assert self._mtu is not None
        oldest = self._window.oldest
        about = self._description if self._starts else b""
        sent = self._window.sent if self._repairs_wanted else (self._next_number, 0)
        first = sent[0] if oldest is None else oldest
        status = Status(first, *sent, dict(self._starts), about, tuple(self._moves))
        self._starts.clear()
        self._status_wanted = False
        self._status_number += 1
        wire = status.to_wire()
        self._status_at_s = now_s + max(_STATUS_GAP_S, len(wire) / _STATUS_BYTES_PER_S)
        return list(self._status.seal(self._status_number, self._flags, wire, self._mtu))
