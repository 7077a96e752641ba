"""Ring of a capsule at its writer: records wait on the disk here until a holder has them; the oldest give way.

I/O. One thread writes and reads, so a slow disk delays no frame. After a crash the ring continues behind the last whole
record. What was confirmed to no holder may be lost with the disk; then another capsule begins.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Collection, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Final, TypeAlias

from gdp.capsule.chain import Chain
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.record import Record, RecordType, find, size_of, split
from gdp.capsule.windows import Mark, Place, Windows
from gdp.errors import GdpError, RemoteError, StoreError
from gdp.names import Name
from gdp.stores.files import private, read_private, write_all
from gdp.stores.segments import SEGMENT_BYTES, Segments

log = logging.getLogger(__name__)

DESCRIPTOR: Final = "descriptor.cbor"
_PARTS: Final = 8  # of the ring, at least: so much is dropped at once
_WAITING_MAX_BYTES: Final = 32 << 20

IndexedRecord: TypeAlias = tuple[int, Record, bytes]  # offset and wire form of a record that is no message


class CapsuleRing:
    """Ring of one capsule.

    Args:
        folder: of the capsules of the same topics; the newest that has all of the descriptor's is continued.
        descriptor: of a capsule that begins now.
        most_bytes: of all records here.
        pool: one thread.

    Attributes:
        chain: state after the records here, for the one that continues it.
        descriptor: of the capsule.
        folder: as given.
        end: behind the last byte that is on the disk.
        begin: of the first byte here.
        next: offset of what is appended next.
        mark: number of the last mark that ``windows`` found; 0: there is none.
        failure: why the disk does not take records; empty while it does.

    Raises:
        GdpError: the folder cannot be read or written.
    """

    def __init__(self, folder: Path, descriptor: Descriptor, most_bytes: int, pool: Executor) -> None:
        self._pool = pool
        self._most_bytes = most_bytes
        self.folder = folder
        self.segment_bytes = min(SEGMENT_BYTES, most_bytes // _PARTS)
        self.descriptor, self.chain, self._segments = _continued(folder, descriptor)
        self.begin, self.end = self._segments.begin, self._segments.end
        self._file_bytes = self.end - self._segments.last  # of the last file, what is under way included
        self.next = self.end
        self._given_bytes = self._done_bytes = 0  # to the thread, and by it
        self.mark = 0
        self.failure = ""

    @property
    def is_ready(self) -> bool:
        """Return whether the disk keeps up."""
        return self._given_bytes - self._done_bytes < _WAITING_MAX_BYTES and not self.failure

    @property
    def is_written(self) -> bool:
        """Return whether all that was appended is on the disk, or has failed."""
        return self._given_bytes == self._done_bytes

    @property
    def wants_file(self) -> bool:
        """Return whether the next checkpoint is to begin a file."""
        return self._file_bytes >= self.segment_bytes or not self.next

    def append(self, data: bytes, *, begins_file: bool) -> None:
        """Append whole records; ``begins_file``: the first one is a checkpoint that begins a file."""
        at = self.next if begins_file else None
        self._file_bytes = len(data) if begins_file else self._file_bytes + len(data)
        self.next += len(data)
        self._given_bytes += len(data)
        self._pool.submit(self._append, data, at)

    def read(self, offset: int, most: int) -> Future[tuple[int, bytes]]:
        """Return what will be the bytes at an offset."""
        return self._pool.submit(self._segments.read, offset, most)

    def trim(self, needed: int) -> None:
        """Drop the files whose records all stand below an offset."""
        self._pool.submit(self._trim, needed)

    def windows(self, before_ns: int, after_ns: int) -> Windows:
        """Return the windows that the records here open."""
        windows, places, segments = Windows(before_ns, after_ns), dict[int, int](), self._segments
        for offset in segments.offsets:
            at, data = 0, segments.read(offset, segments.size_of(offset))[1]
            while find(data, at) == at:  # behind a damage nothing is marked; the audit names it
                end = at + size_of(data, at)
                record = Record.from_wire(data[at:end])
                if record.type is RecordType.CHECKPOINT:
                    places[record.number] = offset + at
                    windows.add_checkpoint(Place(offset + at, record.number, record.time_ns))
                    if windows.is_due(record.time_ns):
                        windows.close(offset + end)
                elif record.type is RecordType.MARK:
                    mark = Mark.from_record(record)
                    windows.open(places.get(mark.first, segments.begin), mark.to_ns)
                    self.mark = record.number
                at = end
        return windows

    def continues(self, folder: Path, descriptor: Descriptor) -> bool:
        """Return whether it is what a ring with these arguments would continue."""
        return self.folder == folder and _has_all(self.descriptor, descriptor)

    def older(self, known: Collection[Name]) -> Iterator[CapsuleRing]:
        """Yield the rings of this writer's other capsules in the folder; what cannot be read is logged, and stays."""
        for place in sorted(self.folder.iterdir()):
            try:
                descriptor = Descriptor.from_cbor(read_private(place / DESCRIPTOR))
                if (
                    descriptor.name not in (self.descriptor.name, *known)
                    and descriptor.writer == self.descriptor.writer
                ):
                    yield CapsuleRing(self.folder, descriptor, self._most_bytes, self._pool)
            except GdpError as error:
                log.warning("capsule is not uploaded path=%s reason=%s", place, error)

    def remove(self) -> None:
        """Close it, and remove it from the disk."""
        self.close()
        shutil.rmtree(self._segments.folder)

    def close(self) -> None:
        """Put everything on the disk; returns when that is done."""
        self._pool.submit(self._segments.close).result()

    def _append(self, data: bytes, at: int | None) -> None:
        """Append in the thread of the pool."""
        segments = self._segments
        try:
            if not self.failure:
                segments.append(data, at=at)
                self._trim(0)
                self.end = segments.end
        except (StoreError, OSError) as error:
            # a record is missing from now on, so nothing may follow it: a new run continues behind the last one
            self.failure = str(error)
            log.error("capsule not written reason=%s; what follows is lost until this node starts again", error)
        finally:
            self._done_bytes += len(data)

    def _trim(self, needed: int) -> None:
        segments = self._segments
        while len(segments.offsets) > 1 and (segments.held_bytes > self._most_bytes or segments.offsets[1] <= needed):
            segments.drop(segments.begin)
        self.begin = segments.begin


def _continued(folder: Path, descriptor: Descriptor) -> tuple[Descriptor, Chain, Segments]:
    """Return the newest capsule in a folder, cut behind its last whole record, or a new one; or the very one."""
    place = folder / f"{descriptor.begun_ms:016x}"
    if place.is_dir():
        segments = Segments(place)
        return descriptor, replayed(descriptor, segments)[0], segments
    known = sorted(folder.iterdir()) if folder.is_dir() else []
    for each in reversed(known):
        try:
            before = Descriptor.from_cbor(read_private(each / DESCRIPTOR))
            if not _has_all(before, descriptor):
                continue
            segments = Segments(each)
            chain, _ = replayed(before, segments)
        except GdpError as error:
            log.warning("capsule cannot be continued, another begins path=%s reason=%s", each, error)
            continue
        return before, chain, segments
    write_all(place, {DESCRIPTOR: private(descriptor.to_cbor())})
    return descriptor, Chain(descriptor.name, descriptor.key), Segments(place)


def _has_all(before: Descriptor, wanted: Descriptor) -> bool:
    return before.writer == wanted.writer and {*before.topics} >= {*wanted.topics}


def replayed(descriptor: Descriptor, segments: Segments) -> tuple[Chain, list[IndexedRecord]]:
    """Return the chain behind the last whole record, and what an index has of the last file.

    A torn write is cut. Raises ``RemoteError``: damage before it.
    """
    while segments.offsets:
        chain, last, at = Chain(descriptor.name, descriptor.key), segments.last, 0
        found = list[IndexedRecord]()
        data = segments.read(last, segments.size_of(last))[1]
        try:
            for wire in split(data):
                record = chain.handle_record(wire, may_skip=True)
                if record.type is not RecordType.MESSAGE:
                    found.append((last + at, record, wire))
                at += len(wire)
        except RemoteError:
            if find(data, at) is not None:
                raise
        if at:
            if at < len(data):
                segments.cut(last + at)
            return chain, found
        segments.drop(last)
    return Chain(descriptor.name, descriptor.key), []
