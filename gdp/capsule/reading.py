"""Reading of a capsule from its holder: the next request, and the messages of a span of time, audited and opened.

Sans-I/O. Records of another time are skipped; what is damaged or missing is named, and the rest is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Final, NamedTuple

from gdp.capsule.audit import Audit
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.opening import CapsuleOpener, Kept
from gdp.capsule.record import RECORD_MAX_BYTES, RECORD_MIN_BYTES, Record, find, size_of, split
from gdp.client.key_epochs import Secrets
from gdp.errors import GdpError, RemoteError
from gdp.names import Name

_END_NS: Final = (1 << 63) - 1


class Lost(NamedTuple):
    """Messages of one topic and incarnation of the writer that no record has, by sequence number, both included."""

    topic: Name
    incarnation: int
    first: int
    last: int


def given(found: Iterable[Descriptor]) -> list[Descriptor]:
    """Return those whose writer the topic's owner let publish when the capsule began."""
    rightful = list[Descriptor]()
    for each in found:
        with suppress(GdpError):
            each.check_right(each.begun_ms / 1e3)
            rightful.append(each)
    return rightful


class CapsuleReader:
    """Reader of one capsule.

    Args:
        secrets: of the topics that are read, by epoch; messages of other epochs stay closed.
        from_ns: read records from the last checkpoint at or before this time on; 0: from the first.
        to_ns: read records up to this time, by the writer's clock.

    Attributes:
        audit: of what was read.
        opener: counts what stays closed.
        lost: messages that are missing between two others; ``left_out``: those between windows.
        is_done: nothing is left to be read.
    """

    def __init__(
        self, descriptor: Descriptor, secrets: Mapping[Name, Secrets], *, from_ns: int = 0, to_ns: int = _END_NS
    ) -> None:
        self.descriptor = descriptor
        self._from_ns, self._to_ns = from_ns, to_ns
        self.audit = Audit(descriptor.name, descriptor.key)
        self.opener = CapsuleOpener(descriptor, secrets)
        self._holes: list[tuple[Lost, int]] = []  # with the number of the checkpoint behind a gap, or 0
        self.is_done = False
        self._offset: int | None = None
        self._rest = b""
        # by topic: incarnation and sequence number of the next message, and number of the last record with one
        self._next: dict[Name, tuple[int, int, int]] = {}

    @property
    def lost(self) -> list[Lost]:
        """Return what is missing, and should not be."""
        return [lost for lost, gap in self._holes if gap not in self.audit.left_out]

    @property
    def left_out(self) -> list[Lost]:
        """Return what the writer left out, since it stood in no window."""
        return [lost for lost, gap in self._holes if gap in self.audit.left_out]

    def next_request(self) -> HolderRequest:
        """Return the next request."""
        if self._offset is None:
            return HolderRequest(ask=Ask.READ, capsule=self.descriptor.name, time_ns=self._from_ns)
        return HolderRequest(ask=Ask.READ, capsule=self.descriptor.name, offset=self._offset)

    def handle_response(self, answer: HolderAnswer) -> Iterator[Kept]:
        """Yield the messages that an answer brings."""
        if self._offset not in (None, answer.offset) and self._rest:
            self._rest = b""  # a record without its end, before a gap
            self.audit.skip()
        for wire in split(answer.described):
            self._open(wire)
        self._offset = answer.offset + len(answer.data)
        data, at = self._rest + answer.data, 0
        while at + RECORD_MIN_BYTES <= len(data):
            size = size_of(data, at)
            if size <= RECORD_MAX_BYTES and at + size > len(data) and answer.data:
                break  # its end is in the next answer
            begin = find(data, at)
            if begin is None and answer.data:
                break  # the next whole record is in the next answer
            if begin != at:
                self.audit.skip()
            if begin is None:
                break
            at = begin + size_of(data, begin)
            yield from self._messages(data[begin:at])
        self._rest = data[at:]
        if not answer.data or self.is_done:
            self.is_done = True
            self.audit.finish()

    def _messages(self, wire: bytes) -> Iterator[Kept]:
        record = Record.from_wire(wire)
        if record.time_ns > self._to_ns and not self.audit.gaps:  # a mark names the cause of a gap before it
            self.is_done = True
            return
        before = self.audit.records
        self.audit.handle_record(wire)
        if self.audit.records == before:
            return  # a second one of this number, or late
        for each in self._open(wire) if record.time_ns <= self._to_ns else ():
            self._count(each, record.number)
            if record.time_ns >= self._from_ns:
                yield each

    def _open(self, wire: bytes) -> list[Kept]:
        try:
            return self.opener.open(Record.from_wire(wire))
        except RemoteError:
            self.audit.skip()
            return []

    def _count(self, kept: Kept, number: int) -> None:
        incarnation, sequence, before = self._next.get(kept.topic, (0, 0, 0))
        if incarnation == kept.incarnation and sequence < kept.sequence:
            behind = next((end for end in (*self.audit.gaps, *self.audit.left_out) if before < end < number), 0)
            self._holes.append((Lost(kept.topic, incarnation, sequence, kept.sequence - 1), behind))
        self._next[kept.topic] = kept.incarnation, kept.sequence + 1, number
