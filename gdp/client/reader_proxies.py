"""Reader proxies of a publisher: its matched readers, their incarnations, and the start of their silence.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: RTPS 2.5, section 8.4.7.

A report opens under a key that depends on its reader's introduction, so no other node can change what a reader has
confirmed.

A reader that is silent for ``READER.lease_s`` is suspended: it may have moved. It does not count as a reader until it
reports again, and is given up ``FORGET_S`` later. What it had confirmed is remembered: should it start again, it learns
what it has lost.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.client.identities import WriterIdentity
from gdp.crypto.control_seal import ControlOpener, ControlReplayWindow, control_key
from gdp.crypto.envelope import seal_key
from gdp.errors import DropReason, EnvelopeError, FrameError, StatementError
from gdp.frame.codec import Header, Kind
from gdp.intervals import FORGET_S, NEVER_S, READER, SERVER
from gdp.message.acknack import AckNack, AckNackFlag
from gdp.message.heartbeat import StreamStart
from gdp.names import Name
from gdp.requests import Backoff

READERS_MAX: Final = 1_024
_INCARNATIONS_MAX: Final = 4_096  # incarnations of readers whose introductions are remembered, and readers given up
_EPOCHS_KEPT: Final = 2  # the one in use and the one before


class ReaderTimeouts(NamedTuple):
    """Timeouts of a publisher's readers, in seconds.

    ``lag_s``: a reader that has not confirmed in this time what another has no longer blocks the window. ``quiet_s``: a
    reader that is silent for this time does not keep up. ``idle_s``: a live reader reports at least this often.
    ``fastest_governs``: the first answer to a message counts, so readers on slower paths do not hold it back.
    """

    lag_s: float
    quiet_s: float
    idle_s: float
    fastest_governs: bool = False


TOPICS: Final = ReaderTimeouts(READER.lease_s, READER.lease_s, READER.refresh_s)
# other replicas must not wait for a dead one
CALLS: Final = ReaderTimeouts(READER.refresh_s, SERVER.lease_s, SERVER.refresh_s, fastest_governs=True)


class _Incarnation:
    """Openers of the reports of one incarnation of a reader, and their replay window."""

    def __init__(self, topic: Name, source: WriterIdentity, incarnation: int, started: int, exchange: bytes) -> None:
        self.started = started
        self._topic = topic
        self._source = source
        self._incarnation = incarnation
        self._shared = source.control_keys.shared(exchange)
        self._numbers = ControlReplayWindow()
        self._openers: dict[bytes, ControlOpener] = {}  # by topic secret

    def open(self, header: Header, frame: bytes, secret: bytes, now_s: float) -> bytes:
        """Return a report's body. Raises ``EnvelopeError``: REPLAYED, MALFORMED or BAD_TAG."""
        self._numbers.check(header.number, now_s)
        opener = self._openers.get(secret)
        if opener is None:
            ends = header.source, self._incarnation, self._source.name, self._source.incarnation
            key = control_key(self._shared, secret, Kind.ACKNACK, *ends, self._topic)
            opener = self._openers[secret] = ControlOpener(key, self._topic, self._source.incarnation)
            if len(self._openers) > _EPOCHS_KEPT:
                del self._openers[next(iter(self._openers))]
        body = opener.open(header, frame)
        self._numbers.accept(header.number, now_s)
        return body


@dataclass(slots=True, kw_only=True)
class ReaderProxy:
    """One reader, in one incarnation of its process.

    Attributes:
        incarnation_id: opens its reports.
        sequence: it has confirmed every message before this one, except ``lost`` of them that it counted as lost.
        advanced_s: when ``sequence`` last rose.
        behind_s: since when its window has been suspended; None: it is not.
    """

    incarnation: int
    incarnation_id: _Incarnation
    heard_s: float
    sequence: int = 0
    lost: int = 0
    advanced_s: float = 0.0
    behind_s: float | None = None
    start: StreamStart | None = None  # None once it has begun to confirm
    out_until_s: float = 0.0  # it must not block the window before
    suspensions: int = 0


class ReaderProxies:
    """Readers of one publisher, by name.

    Attributes:
        active: those that are not suspended.
        is_reachable: a tree to them is installed.
        changes: how often one became active, or stopped being so.
        confirmed: ``sequence`` of the last incarnation of a reader that is over, by name; oldest first.
    """

    def __init__(self, topic: Name, source: WriterIdentity, patience: ReaderTimeouts = TOPICS) -> None:
        self._topic = topic
        self._source = source
        self._patience = patience
        self._suspensions = Backoff(2 * patience.lag_s, 16 * patience.lag_s)
        self.active: dict[bytes, ReaderProxy] = {}
        self._suspended: dict[bytes, ReaderProxy] = {}
        self._incarnation_ids: OrderedDict[tuple[bytes, int], _Incarnation] = OrderedDict()
        self.confirmed: dict[bytes, int] = {}
        self.is_reachable = False
        self.changes = 0

    def is_read_by(self, name: bytes) -> bool:
        """Return whether a tree is installed, and ``name`` is a reader, keeping up or not."""
        return self.is_reachable and name in self.active

    def reporting(self, now_s: float) -> list[bytes]:
        """Return the readers to which a tree is installed; those that have missed reports come last."""
        return sorted(self.active, key=lambda name: self.is_quiet(name, now_s)) if self.is_reachable else []

    def names(self) -> list[bytes]:
        """Return the names of all, suspended ones included."""
        return [*self.active, *self._suspended]

    def all(self) -> list[ReaderProxy]:
        """Return all, suspended ones included."""
        return [*self.active.values(), *self._suspended.values()]

    def silent(self, now_s: float) -> list[bytes]:
        """Return those that have not been heard for ``READER.lease_s``."""
        return [name for name, reading in self.active.items() if now_s - reading.heard_s > READER.lease_s]

    def next_silent(self) -> float:
        """Return the monotonic second at which ``silent`` or ``overdue`` is no longer empty; infinity: never."""
        due_s = NEVER_S
        for each in self.active.values():
            silent_s = each.heard_s + READER.lease_s
            due_s = silent_s if silent_s < due_s else due_s
            if each.behind_s is not None and each.behind_s + FORGET_S < due_s:
                due_s = each.behind_s + FORGET_S
        for each in self._suspended.values() if self._suspended else ():
            if each.behind_s is not None and each.behind_s + FORGET_S < due_s:
                due_s = each.behind_s + FORGET_S
        return due_s + 0.001

    def suspend(self, name: bytes, now_s: float) -> None:
        """Suspend a silent reader, until it reports again or is forgotten."""
        reading = self._suspended[name] = self.active.pop(name)
        self.changes += 1
        reading.behind_s = now_s if reading.behind_s is None else reading.behind_s

    def is_suspended(self, name: bytes) -> bool:
        """Return whether a node is a suspended reader."""
        return name in self._suspended

    def resume(self, name: bytes, now_s: float) -> bool:
        """Reactivate a suspended reader; return whether it was suspended."""
        reading = self._suspended.pop(name, None)
        if reading is None:
            return False
        reading.heard_s = now_s
        self.active[name] = reading
        self.changes += 1
        return True

    def overdue(self, now_s: float) -> list[tuple[bytes, ReaderProxy]]:
        """Return those whose window has been suspended for ``FORGET_S``, and the first of too many."""
        everyone = [*self.active.items(), *self._suspended.items()]
        late = [each for each in everyone if each[1].behind_s is not None and now_s - each[1].behind_s > FORGET_S]
        return late or list(self._suspended.items())[: max(len(self._suspended) - READERS_MAX, 0)]

    def is_quiet(self, name: bytes, now_s: float) -> bool:
        """Return whether a reader has missed two of its reports: it is absent rather than slow."""
        return now_s - self.active[name].heard_s > 2 * self._patience.idle_s

    def is_alive(self, name: bytes, now_s: float, awake_s: float) -> bool:
        """Return whether a node is a reader, and was not silent for too long since ``awake_s``."""
        reading = self.active.get(name)
        return reading is not None and now_s - max(reading.heard_s, awake_s) <= self._patience.quiet_s

    def suspend_again(self, name: bytes, now_s: float) -> None:
        """Exclude a reader from the window for a penalty time, each time for longer."""
        reading = self.active[name]
        reading.suspensions += 1
        reading.out_until_s = now_s + self._suspensions.pause_s(reading.suspensions)

    def record_key(self, name: bytes, incarnation: int, started: int, exchange: bytes) -> None:
        """Note the key of one incarnation of a reader, proven by its introduction or advertisement.

        Raises:
            StatementError: MALFORMED, it is no key.
        """
        incarnation_id = (name, incarnation)
        if incarnation_id not in self._incarnation_ids:
            self._incarnation_ids[incarnation_id] = _Incarnation(
                self._topic, self._source, incarnation, started, exchange
            )
            if len(self._incarnation_ids) > _INCARNATIONS_MAX:
                self._incarnation_ids.popitem(last=False)

    def admit(self, name: bytes, incarnation: int, now_s: float) -> ReaderProxy:
        """Make a known node a reader, in place of a former incarnation of it."""
        self._end(name, self.active.get(name) or self._suspended.pop(name, None))
        incarnation_id = self._incarnation_ids[name, incarnation]
        reading = self.active[name] = ReaderProxy(incarnation=incarnation, incarnation_id=incarnation_id, heard_s=now_s)
        self.changes += 1
        return reading

    def forget(self, name: bytes) -> bool:
        """Forget a reader, suspended or not; return whether it was one."""
        self.confirmed.pop(name, None)
        self.changes += 1
        return (self.active.pop(name, None) or self._suspended.pop(name, None)) is not None

    def give_up(self, name: bytes) -> None:
        """Forget a suspended reader but for what it has confirmed, which counts if it starts again."""
        self._end(name, self._suspended.pop(name))

    def _end(self, name: bytes, former: ReaderProxy | None) -> None:
        """Note what an incarnation had confirmed; one that never began says nothing of what an earlier one lacks."""
        if former is not None and (former.start is None or name not in self.confirmed):
            self.confirmed[name] = former.sequence
            if len(self.confirmed) > _INCARNATIONS_MAX:
                del self.confirmed[next(iter(self.confirmed))]

    def introduce(self, header: Header, frame: bytes, secret: bytes) -> None:
        """Process the sealed introduction of a reader; that of a known incarnation is not opened.

        Args:
            secret: topic secret of the epoch in use.

        Raises:
            RemoteError: it does not open, is invalid, or is of an earlier incarnation than the reader's present one.
        """
        incarnation_id, source = (header.source, header.incarnation), self._source
        reading = self._reading_of(header.source)
        if incarnation_id in self._incarnation_ids or (
            reading is not None and reading.incarnation == header.incarnation
        ):
            return
        key = seal_key(secret, Kind.INTRODUCTION, header.source, header.incarnation, source.name)
        body = ControlOpener(key, self._topic, source.incarnation).open(header, frame)
        introduction = source.control_keys.introduced(body, Name(header.source), header.incarnation)
        if reading is not None and introduction.started <= reading.incarnation_id.started:
            raise StatementError(DropReason.STALE, "an introduction of an earlier life")
        self.record_key(header.source, header.incarnation, introduction.started, introduction.exchange)

    def open(
        self, header: Header, frame: bytes, secret: bytes, now_s: float, *, may_begin: bool
    ) -> tuple[AckNack, bool]:
        """Return a reader's opened report, and whether that reader, or this incarnation of it, is new.

        Args:
            secret: topic secret of the report's epoch.
            may_begin: whether a node that is no reader yet may become one.

        Raises:
            RemoteError: it does not open, is a replay, or is of an incarnation that is over or was not introduced.
        """
        name = header.source
        reading = self._reading_of(name)
        is_current = reading is not None and reading.incarnation == header.incarnation
        incarnation_id = (
            reading.incarnation_id
            if reading is not None and is_current
            else self._incarnation_ids.get((name, header.incarnation))
        )
        if incarnation_id is None:
            raise FrameError(DropReason.UNKNOWN_SENDER, "a note of a life that did not introduce itself")
        acknack = AckNack.from_wire(incarnation_id.open(header, frame, secret, now_s))
        is_new = acknack.flags is AckNackFlag.NEW
        if not may_begin and (is_new or not is_current):
            raise EnvelopeError(DropReason.UNKNOWN_EPOCH, "a new reader under an epoch that is over")
        if name not in self.active and len(self.active) >= READERS_MAX:
            raise EnvelopeError(DropReason.QUOTA, "readers")
        if reading is not None and is_current:
            reading.heard_s = now_s
            if self._suspended:
                self.resume(name, now_s)
            return acknack, False
        if reading is not None and (not is_new or incarnation_id.started <= reading.incarnation_id.started):
            raise FrameError(DropReason.UNKNOWN_SENDER, "a report of a life that never began, or is over")
        self._incarnation_ids.move_to_end((name, header.incarnation))
        self.admit(name, header.incarnation, now_s)
        return acknack, True

    def _reading_of(self, name: bytes) -> ReaderProxy | None:
        return self.active.get(name) or self._suspended.get(name)
