"""One topic as its publisher sees it: number, seal, keep, pace, repair.

Place: pure; time comes in as ``now_s`` (monotonic seconds). Frames come out of ``take`` and go to the switch.

A message is sealed once. Without a reader nothing is sealed; the last ``depth`` messages of a latched topic wait for late
joiners.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gdp.crypto.envelope import Sealer, Signer
from gdp.crypto.note import NoteOpener
from gdp.errors import DropReason, EnvelopeError, FrameError, LocalError, RemoteError
from gdp.frame.codec import Header
from gdp.frame.kinds import Flag, Kind
from gdp.limits import MTU_MIN_BYTES, READER_LEASE_S
from gdp.message.report import Report, ReportFlag
from gdp.message.status import STARTS_MAX, Status
from gdp.message.window import SendWindow
from gdp.names import Name

__all__ = ["Publisher", "Secrets", "Source"]

_READERS_MAX: Final = 1_024

Secrets = Mapping[int, bytes]  # key epoch -> topic secret, 32 bytes


@dataclass(frozen=True, slots=True)
class Source:
    """Who publishes, in this life of its process."""

    name: Name
    incarnation: int
    signer: Signer


@dataclass(slots=True)
class _Reader:
    opener: NoteOpener
    incarnation: int
    epoch: int
    heard_s: float


class Publisher:
    """Publishes one topic.

    Args:
        secrets: topic secrets by epoch; the newest seals.
        description: what a reader must know to understand the messages; travels sealed.
        depth: how many messages late joiners get (0: none).
    """

    def __init__(
        self, topic: Name, source: Source, secrets: Secrets, description: bytes, *, reliable: bool, depth: int = 0
    ) -> None:
        if not secrets:
            raise LocalError("a publisher needs a topic secret")
        self.topic = topic
        self._source = source
        self._secrets = secrets
        self._description = description
        self._repairs_wanted = reliable or depth > 0
        self._flags = (Flag.RELIABLE if reliable else 0) | (Flag.LATCHED if depth else 0)
        self._window = SendWindow(depth)
        self._depth = depth
        self._epoch = max(secrets)
        self._data = self._sealer(Kind.DATA)
        self._status = self._sealer(Kind.STATUS)
        self._next_number = 1
        self._status_number = 0
        self._mtu: int | None = None  # unknown until a tree stands
        self._readers: dict[bytes, _Reader] = {}
        self._starts: dict[bytes, int] = {}
        self._status_wanted = False
        self._waiting = deque[bytes]()  # best-effort and status frames
        self._early = deque[bytes](maxlen=depth or None)  # latched messages from before the first reader
        self.drops: Counter[DropReason] = Counter()
        self.messages = 0
        self.payload_bytes = 0

    @property
    def readers(self) -> int:
        """Return how many readers have introduced themselves and are alive."""
        return len(self._readers)

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
        return self._window.acknowledged if self._repairs_wanted else self.messages

    def tree_stands(self, mtu: int) -> None:
        """Learn that a tree reaches this publisher, and the smallest MTU on it (bytes after the Ethernet header)."""
        self._mtu = max(mtu, MTU_MIN_BYTES)

    def publish(self, message: bytes) -> int | None:
        """Seal and queue a message; return its number, or None when nobody is there to read it.

        Raises:
            LocalError: above the limits.
        """
        if self._mtu is None or not self._readers:
            if self._depth:
                self._early.append(message)
            else:
                self.drops[DropReason.NO_READER] += 1
            return None
        number = self._next_number
        self._next_number += 1
        frames = self._data.seal(number, self._flags, message, self._mtu)
        self.messages += 1
        self.payload_bytes += len(message)
        if self._repairs_wanted:
            self._window.add(number, frames)
        else:
            self._waiting.extend(frames)
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
            del self._readers[name]
            self._window.drop_reader(name)
        elif ReportFlag.NEW in report.flags:
            self._welcome(name, now_s)
        elif self._window.has_reader(name):
            self._window.report(name, report, now_s)
            oldest = self._window.oldest
            if report.missing and (oldest is None or report.missing[0].number < oldest):
                self._status_wanted = True  # it asks for what is gone

    def timeout(self, now_s: float) -> None:
        """Let silent readers go, and ask those that owe a report."""
        silent = [name for name, reader in self._readers.items() if now_s - reader.heard_s > READER_LEASE_S]
        for name in silent:
            del self._readers[name]
            self._window.drop_reader(name)
        if self._window.probe_due(now_s):
            self._status_wanted = True

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        lease = min((reader.heard_s for reader in self._readers.values()), default=None)
        times = [self._window.next_probe(), None if lease is None else lease + READER_LEASE_S + 0.001]
        return min((time for time in times if time is not None), default=None)

    def take(self, now_s: float) -> list[bytes]:
        """Return the frames that may go now."""
        if self._mtu is None or not self._readers:
            return []
        while self._early:
            self.publish(self._early.popleft())
        if self._status_wanted:
            self._waiting.extend(self._seal_status())
        frames = list(self._waiting)
        self._waiting.clear()
        return frames + self._window.take(now_s)

    def _sealer(self, kind: Kind) -> Sealer:
        source = self._source
        secret = self._secrets[self._epoch]
        return Sealer(secret, self._epoch, kind, source.name, source.incarnation, self.topic, source.signer)

    def _open_report(self, header: Header, frame: bytes, now_s: float) -> Report:
        name = header.source
        reader = self._readers.get(name)
        if reader is None or reader.incarnation != header.incarnation or reader.epoch != header.epoch:
            secret = self._secrets.get(header.epoch)
            if secret is None:
                raise EnvelopeError(DropReason.UNKNOWN_EPOCH)
            if reader is None and len(self._readers) >= _READERS_MAX:
                raise EnvelopeError(DropReason.QUOTA, "readers")
            opener = NoteOpener(secret, Kind.REPORT, name, header.incarnation, self._source.name)
            reader = _Reader(opener, header.incarnation, header.epoch, now_s)
        report = Report.from_wire(reader.opener.open(header, frame))
        if self._readers.get(name) is not reader and ReportFlag.NEW not in report.flags:
            raise FrameError(DropReason.UNKNOWN_SENDER, "a report from a reader that never began")
        self._readers[name] = reader
        reader.heard_s = now_s
        return report

    def _welcome(self, name: bytes, now_s: float) -> None:
        if name not in self._starts and len(self._starts) < STARTS_MAX:
            oldest = self._window.oldest
            start = oldest if self._depth and oldest is not None else self._next_number
            if self._repairs_wanted:
                self._window.add_reader(name, start, now_s)
            self._starts[name] = start
        self._status_wanted = True

    def _seal_status(self) -> list[bytes]:
        assert self._mtu is not None
        oldest = self._window.oldest
        about = self._description if self._starts else b""
        status = Status(self._next_number if oldest is None else oldest, self._next_number, dict(self._starts), about)
        self._starts.clear()
        self._status_wanted = False
        self._status_number += 1
        return self._status.seal(self._status_number, self._flags, status.to_wire(), self._mtu)
