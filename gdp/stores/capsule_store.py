"""Store of a holder: capsules of others, which it verifies and cannot open.

I/O. A folder for each capsule has its descriptor and its segments. ``index.db`` (SQLite) finds times, and is rebuilt
from the segments where it lacks some. Bytes are confirmed after they are on the disk, or in the bucket if there is one
(``bucket_upkeep``), so a power cut loses nothing that was confirmed. Records are verified before they are written: they
extend the chain, and each checkpoint has the writer's signature. The client that appends is the writer, whom the
topic's owner lets publish.
"""

from __future__ import annotations

import logging
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from random import SystemRandom
from typing import Final

from gdp.capsule.audit import Audit
from gdp.capsule.chain import CHECKPOINT_BYTES, Chain
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import BATCH_BYTES, LISTED_MAX, SYNCED_MAX, Ask, HolderAnswer, HolderRequest
from gdp.capsule.record import RECORD_MAX_BYTES, Record, RecordType, number_of, split
from gdp.closing import ClosedOnExit
from gdp.errors import GdpError, LocalError, RemoteError, StoreError
from gdp.exchange.sync_set import HASH_BYTES, SyncSet
from gdp.frame.codec import decode
from gdp.intervals import MINUTE_S
from gdp.names import ZERO, Name
from gdp.stores.bucket import StoredObject
from gdp.stores.capsule_ring import DESCRIPTOR, IndexedRecord, replayed
from gdp.stores.files import private, read_private, write_all
from gdp.stores.segments import SEGMENT_BYTES, Segments
from gdp.stores.transactions import TransactionFile

log = logging.getLogger(__name__)

_RESTS_MAX_BYTES: Final = 4 * RECORD_MAX_BYTES
_MARKS_MAX: Final = 1_024  # in one answer
_HEAD_BITS: Final = 24  # of the chain's head in a rank
SPARE_BYTES: Final = 256 << 20  # of the disk, for what others write
_BACKED_PARTS: Final = 8  # an open segment goes to a bucket again and again: it is smaller, and of less than this time
_BACKED_NS: Final = 10 * MINUTE_S * 10**9
_TABLE: Final = """
CREATE TABLE IF NOT EXISTS checkpoints (
    capsule BLOB, offset INTEGER, number INTEGER, time_ns INTEGER, PRIMARY KEY (capsule, offset)
) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS times ON checkpoints (capsule, time_ns);
CREATE TABLE IF NOT EXISTS descriptions (
    capsule BLOB, number INTEGER, wire BLOB, PRIMARY KEY (capsule, number)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS objects (
    capsule BLOB, offset INTEGER, size INTEGER, tag TEXT, PRIMARY KEY (capsule, offset)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS marks (capsule BLOB, number INTEGER, wire BLOB, PRIMARY KEY (capsule, number)) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
class StoreLimits:
    """Limits of a holder.

    Attributes:
        owner_bytes: of all capsules of one owner's topics, and of one writer's; an empty one counts for a MiB.
        capsule_bytes: beyond it the oldest segments of a capsule go; None: no limit.
        age_s: older segments go; None: no limit.
        spare_bytes: free space of the disk below which appends are refused.
        cache_bytes: of the disk, for what a bucket has or shall have; None: there is no bucket.
    """

    owner_bytes: int
    capsule_bytes: int | None = None
    age_s: float | None = None
    spare_bytes: int = SPARE_BYTES
    cache_bytes: int | None = None


class StoredCapsule:
    """One capsule on the disk.

    Attributes:
        chain: state after the last whole record.
        checkpoint: offset of its last checkpoint.
        rest: bytes of a record whose end has not come; in memory alone, and not confirmed.
        backed: behind the last byte that the bucket has; None: there is no bucket.
        file_ns: time of the first record of the last segment.
        parties: keys of the topics' owners, and the writer's name.
        damage: why it takes no records; empty: it does.
    """

    def __init__(self, folder: Path, spare_bytes: int = 0) -> None:
        self.descriptor = Descriptor.from_cbor(read_private(folder / DESCRIPTOR))
        self.name, self.parties = self.descriptor.name, _parties_of(self.descriptor)
        self.segments = Segments(folder, spare_bytes)
        self.chain = Chain(self.name, self.descriptor.key)
        self.rest = b""
        self.checkpoint = self.file_ns = 0
        self.backed: int | None = None
        self.damage = ""

    @property
    def confirmed(self) -> int:
        """Return the offset behind the last byte that no power cut loses, and no lost disk if there is a bucket."""
        return self.segments.end if self.backed is None else self.backed

    @property
    def pinned_bytes(self) -> int:
        """Return the bytes that stay on the disk: the last segment, and what the bucket does not have."""
        segments, pinned = self.segments, 0
        for offset in reversed(segments.offsets):
            if offset != segments.last and offset + segments.size_of(offset) <= self.confirmed:
                break
            pinned += segments.size_of(offset)
        return pinned

    @property
    def next(self) -> int:
        """Return the offset that is expected next."""
        return self.segments.end + len(self.rest)

    def audit(self, *, known: bytes | None = None, is_deep: bool = False) -> Audit:
        """Return the finished audit of all segments."""
        audit, end = Audit(self.name, self.descriptor.key, known=known, is_deep=is_deep), None
        for offset in self.segments.offsets:
            if end not in (None, offset):
                log.info("capsule has a gap name=%s offset=%d", self.name.short, offset)
            audit.add(self.segments.read(offset, self.segments.size_of(offset))[1])
            end = offset + self.segments.size_of(offset)
        audit.finish()
        return audit


def stored(folder: Path, spare_bytes: int = 0) -> Iterator[StoredCapsule]:
    """Yield the capsules of a store; a damaged descriptor is logged. ``spare_bytes``: as for ``Segments``."""
    for place in sorted(folder.iterdir()) if folder.is_dir() else ():
        if (place / DESCRIPTOR).exists():
            try:
                yield StoredCapsule(place, spare_bytes)
            except GdpError as error:
                log.error("capsule cannot be read path=%s reason=%s", place, error)


class CapsuleStore(ClosedOnExit):
    """Capsules in a folder, and the answers to requests.

    Args:
        unix_s: returns the present Unix second.

    Attributes:
        heads: of each capsule, where its last checkpoint is, with first bytes of the chain's head there.
        index: of all capsules. ``lock``: of the files, and of what is known about them.
        refusal: why no records are taken; empty: they are.

    Raises:
        GdpError: the folder cannot be read or written.
    """

    def __init__(self, folder: Path, limits: StoreLimits, unix_s: Callable[[], float] = time.time) -> None:
        self.folder = folder
        self.limits = limits
        self._unix_s = unix_s
        self.lock = threading.RLock()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.index = index_of(folder)
        self._capsules: dict[Name, StoredCapsule] = {}
        self.heads = SyncSet[int](int)
        self._faults: dict[Name, str] = {}
        self._new_faults: dict[Name, str] = {}
        self.refusal = ""
        for capsule in stored(folder, limits.spare_bytes):
            self._capsules[capsule.name] = capsule
            capsule.backed = None if limits.cache_bytes is None else 0
            self.resume(capsule)

    def handle(self, wire: bytes, client: Name) -> bytes:
        """Return the answer to a request.

        Raises:
            GdpError: it is refused; the text says why.
        """
        request = HolderRequest.from_cbor(wire)
        if request.ask is Ask.READ:  # may wait for a bucket
            known = self._capsules.get(request.capsule)
            return (HolderAnswer() if known is None else self._read(known, request)).to_cbor()
        with self.lock:
            if request.ask is Ask.LIST:
                found = [each.descriptor for each in self._capsules.values()]
                of_topic = [each for each in found if request.topic in (ZERO, *each.topics)]
                return HolderAnswer(descriptors=tuple(of_topic[:LISTED_MAX])).to_cbor()
            if request.ask is Ask.APPEND:
                return self._append(request, client).to_cbor()
            if request.ask is Ask.SYNC:
                return self._compare(request.data).to_cbor()
            capsule = self._capsules.get(request.capsule)
            if capsule is None:
                return HolderAnswer().to_cbor()
            if request.ask is Ask.MARKS:
                return HolderAnswer(data=b"".join(_marks(self.index, capsule.name))).to_cbor()
            return HolderAnswer(head=capsule.confirmed, offset=capsule.segments.end).to_cbor()

    def lines(self) -> tuple[bytes, bytes]:
        """Return the total of what is held, and lines of it, for a request to another holder."""
        with self.lock:
            return self.heads.total, self.heads.lines(b"")

    def adopt(self, descriptor: Descriptor, *, has_quota: bool = True) -> StoredCapsule:
        """Return a capsule that another holder or the bucket has, a new one if it is not here.

        Args:
            has_quota: it is not the bucket's, so it needs space for a batch.

        Raises:
            GdpError: its writer had no right when it began, a quota has no space for a batch, or the disk refuses.
        """
        with self.lock:
            known = self._capsules.get(descriptor.name)
            capsule = known or self._create(descriptor, descriptor.begun_ms / 1e3, has_quota=has_quota)
            if has_quota:
                self._refuse_above_quota(capsule.parties, capsule, BATCH_BYTES)
            return capsule

    def resume(self, capsule: StoredCapsule) -> None:
        """Continue behind the segments as they are now. Raises ``GdpError``: they cannot be read."""
        with self.lock:
            try:
                self._resume(capsule)
            except RemoteError as error:
                self.suspend(capsule, str(error))

    def take_backed(self, capsule: StoredCapsule, offset: int, size: int, data: bytes = b"") -> None:
        """Have the bucket's segment at an offset in place of what is here, unless more is here; index ``data``."""
        segments = capsule.segments
        with self.lock:
            is_here = offset in segments.offsets and offset not in segments.absent
            if size > segments.size_of(offset) or (size < segments.size_of(offset) and not is_here):
                segments.set_absent(offset, size)
            self._index_records(capsule, offset, data)

    def fetch_again(self, capsule: StoredCapsule, offset: int) -> bool:
        """Replace a damaged segment by that of the bucket; return whether it has it. Raises ``GdpError``: not now."""
        segments, known = capsule.segments, object_of(self.index, capsule.name, offset)
        if segments.fetch is None or known is None or known.size != segments.size_of(offset):
            return False
        if offset != segments.last:
            segments.fetch(offset)
            return True
        with self.lock:  # nothing is appended meanwhile
            segments.evict(offset)
            segments.read(offset, 1)
            if capsule.damage:
                self._resume(capsule)
        return True

    def checkpoints(self, capsule: StoredCapsule) -> list[int]:
        """Return the offsets of its checkpoints, the last one first."""
        with self.index.reading() as index:
            rows = index.execute(
                "SELECT offset FROM checkpoints WHERE capsule = ? ORDER BY offset DESC", (capsule.name,)
            ).fetchall()
        return [offset for (offset,) in rows]

    def add(self, capsule: StoredCapsule, offset: int, data: bytes) -> bool:
        """Append proven records of another holder; return whether any of them were missing at the end.

        Raises:
            GdpError: as ``handle``.
        """
        with self.lock:
            before = capsule.segments.end
            self._add(capsule, offset, data)
        return capsule.segments.end != before

    def replace(self, capsule: StoredCapsule, offset: int, data: bytes) -> bool:
        """Replace the beginning of a segment by proven records of another holder; return whether that changed it.

        Raises:
            GdpError: the disk refuses, or what is behind them is still damaged.
        """
        segments = capsule.segments
        with self.lock:
            try:
                old = segments.read(offset, segments.size_of(offset))[1]
            except StoreError:  # the file is gone
                old = b""
            new = data + old[len(data) :]
            if new == old or (offset not in segments.offsets and offset > segments.begin):
                return False  # or it was dropped meanwhile
            segments.replace(offset, new)
            if capsule.damage and offset == segments.last:
                self._resume(capsule)
            self._index_records(capsule, offset, data)
            return True

    def retire(self, capsule: StoredCapsule) -> None:
        """Drop the oldest segments beyond the limits; the last one stays."""
        with self.lock:
            self._retire(capsule)

    def gaps(self, capsule: StoredCapsule) -> list[int]:
        """Return where the segments begin behind which bytes are missing; 0: before the first, and none are dropped."""
        segments, limits = capsule.segments, self.limits
        gaps = [each for each, later in pairwise(segments.offsets) if each + segments.size_of(each) < later]
        return [0, *gaps] if segments.begin and limits.capsule_bytes is limits.age_s is None else gaps

    @property
    def capsules(self) -> list[StoredCapsule]:
        """Return the capsules here."""
        with self.lock:
            return list(self._capsules.values())

    def suspend(self, capsule: StoredCapsule, why: str) -> None:
        """Take no more records of a capsule."""
        capsule.damage = why
        self.note(capsule.name, why)

    def note(self, name: Name, fault: str) -> None:
        """Note what is wrong with a capsule, here or at another holder; the same is reported once."""
        if self._faults.get(name) != fault:
            self._faults[name] = fault
            self._new_faults[name] = fault
            if len(self._faults) > LISTED_MAX:
                del self._faults[next(iter(self._faults))]
            log.error("capsule fault name=%s reason=%s", name.short, fault)

    def poll_faults(self) -> dict[Name, str]:
        """Return, once, new faults by capsule."""
        faults, self._new_faults = self._new_faults, {}
        return faults

    def close(self) -> None:
        """Close all files."""
        for capsule in self._capsules.values():
            capsule.segments.close()
        self.index.close()

    def _read(self, capsule: StoredCapsule, request: HolderRequest) -> HolderAnswer:
        offset, segments = request.offset, capsule.segments
        if request.time_ns:
            with self.index.reading() as index:
                found = index.execute(
                    "SELECT offset FROM checkpoints WHERE capsule = ? AND time_ns <= ? AND offset >= ?"
                    " ORDER BY time_ns DESC, offset DESC LIMIT 1",
                    (capsule.name, request.time_ns, segments.begin),
                ).fetchone()
            offset = segments.begin if found is None else found[0]
        offset, data = segments.read(offset, BATCH_BYTES)
        described = b""
        if data and (request.time_ns or offset != request.offset):
            described = _described(self.index, capsule, number_of(data))
        return HolderAnswer(head=segments.end, offset=offset, data=data, described=described)

    def _compare(self, data: bytes) -> HolderAnswer:
        """Return the total, or what the sender of these lines lacks in part."""
        if len(data) == HASH_BYTES:
            return HolderAnswer(data=self.heads.total)
        newer = self.heads.newer(b"", data)
        drawn = SystemRandom().sample(newer, min(len(newer), SYNCED_MAX))  # those that it refuses hide no others
        return HolderAnswer(descriptors=tuple(self._capsules[Name(each)].descriptor for each in drawn))

    def _append(self, request: HolderRequest, client: Name) -> HolderAnswer:
        capsule = self._capsules.get(request.capsule)
        if capsule is None:
            descriptor = request.descriptor
            if descriptor is None or descriptor.name != request.capsule:
                raise LocalError(f"{request.capsule.short}: not held here, and not described")
            _refuse_others(descriptor, client)
            capsule = self._create(descriptor, self._unix_s())
        _refuse_others(capsule.descriptor, client)
        missing = request.offset - capsule.next - request.gap
        if missing > 0:
            raise StoreError(f"{capsule.name.short}: {missing} bytes before {request.offset} have not come")
        self._add(capsule, request.offset, request.data)
        return HolderAnswer(head=capsule.confirmed, offset=capsule.next)

    def _add(self, capsule: StoredCapsule, offset: int, data: bytes) -> None:
        if capsule.damage:
            raise LocalError(f"{capsule.name.short}: damaged here ({capsule.damage}); see gdp store verify")
        if self.refusal:
            raise StoreError(self.refusal)
        segments, rest = capsule.segments, capsule.rest
        behind = offset - capsule.next
        if behind < 0:  # it came before, at least in part
            known, come = rest[max(offset - segments.end, 0) :], data[max(segments.end - offset, 0) :]
            if not segments.has(offset, data) or not known.startswith(come[: len(known)]):
                raise LocalError(f"{capsule.name.short}: other bytes are at {offset} here: a fork")
            data = data[-behind:]
        if data:
            self._refuse_above_quota(capsule.parties, capsule, len(data))
            self._extend(capsule, data, offset if behind > 0 else None)
            self._retire(capsule)

    def _extend(self, capsule: StoredCapsule, data: bytes, gap_end: int | None) -> None:
        """Verify and write the records that are complete with these bytes.

        Args:
            gap_end: where the bytes begin, if records before them never came.
        """
        segments, chain = capsule.segments, copy(capsule.chain)
        chain.leaves = list(chain.leaves)
        come = data if gap_end is not None else capsule.rest + data
        begin = segments.end if gap_end is None else gap_end
        files, at = [0], 0  # where files begin in ``come``
        is_backed, file_ns = self.limits.cache_bytes is not None, 0 if gap_end is not None else capsule.file_ns
        file_bytes, most_ns = (
            (SEGMENT_BYTES // _BACKED_PARTS, _BACKED_NS) if is_backed else (SEGMENT_BYTES, sys.maxsize)
        )
        found = list[IndexedRecord]()
        file_at = segments.last - begin if gap_end is None and segments.offsets else 0
        for wire in split(come):
            record = chain.handle_record(wire, may_skip=gap_end is not None and not at)
            if record.type is not RecordType.MESSAGE:
                found.append((begin + at, record, wire))
            is_full = at - file_at >= file_bytes or record.time_ns - (file_ns or record.time_ns) >= most_ns
            if record.type is RecordType.CHECKPOINT and is_full and at > file_at:
                files.append(at)
                file_at, file_ns = at, 0
            file_ns = file_ns or record.time_ns
            at += len(wire)
        if gap_end is not None and not at:
            raise LocalError(f"{capsule.name.short}: a gap ends with a whole checkpoint")
        for index, (first, end) in enumerate(pairwise([*files, at])):
            is_new = index > 0 or gap_end is not None
            if end > first:
                segments.append(come[first:end], at=begin + first if is_new else None)
        capsule.chain, capsule.rest, capsule.file_ns = chain, come[at:], file_ns
        self._put(capsule, found)

    def _create(self, descriptor: Descriptor, unix_s: float, *, has_quota: bool = True) -> StoredCapsule:
        descriptor.check_right(unix_s)
        if has_quota:
            self._refuse_above_quota(_parties_of(descriptor), None, 0)
        place = self.folder / descriptor.name.to_text()
        write_all(place, {DESCRIPTOR: private(descriptor.to_cbor())}, force=True)
        capsule = self._capsules[descriptor.name] = StoredCapsule(place, self.limits.spare_bytes)
        capsule.backed = None if self.limits.cache_bytes is None else 0
        log.info(
            "capsule begun name=%s topics=%s", capsule.name.short, ",".join(each.short for each in descriptor.topics)
        )
        return capsule

    def _refuse_above_quota(self, parties: Sequence[bytes], begun: StoredCapsule | None, more: int) -> None:
        if sum(len(each.rest) for each in self._capsules.values()) > _RESTS_MAX_BYTES:
            raise StoreError("too many records are incomplete here; try again")
        most, cache_bytes = self.limits.owner_bytes, self.limits.cache_bytes
        if cache_bytes is not None and sum(each.pinned_bytes for each in self._capsules.values()) + more > cache_bytes:
            raise StoreError(f"the disk here has {cache_bytes} bytes for what the bucket lacks, and they are used")
        for party in parties:
            found = [each for each in self._capsules.values() if party in each.parties]
            used = sum(max(each.segments.held_bytes, CHECKPOINT_BYTES) for each in found if each is not begun)
            held = 0 if begun is None else begun.segments.held_bytes
            if used + max(held + more, CHECKPOINT_BYTES) > most:
                whose = "writer" if party == parties[-1] else "topics' owner"
                detail = f"the {whose} has {used + held} bytes here, of {most}"
                raise StoreError(f"{detail}: remove capsules, or raise the quota")

    def _retire(self, capsule: StoredCapsule) -> None:
        segments, limits = capsule.segments, self.limits
        before = segments.begin
        while len(segments.offsets) > 1:
            is_above = limits.capsule_bytes is not None and segments.held_bytes > limits.capsule_bytes
            if not is_above and not self._is_aged(capsule, segments.offsets[1]):
                break
            segments.drop(segments.begin)
        if segments.begin != before:
            with self.index.writing() as index:
                index.execute(
                    "DELETE FROM checkpoints WHERE capsule = ? AND offset < ?", (capsule.name, segments.begin)
                )

    def _is_aged(self, capsule: StoredCapsule, next_offset: int) -> bool:
        """Return whether all records before an offset, where a segment begins, are too old."""
        if self.limits.age_s is None:
            return False
        with self.index.reading() as index:
            row = index.execute(
                "SELECT time_ns FROM checkpoints WHERE capsule = ? AND offset = ?", (capsule.name, next_offset)
            ).fetchone()
        return row is not None and row[0] < (self._unix_s() - self.limits.age_s) * 1e9

    def _resume(self, capsule: StoredCapsule) -> None:
        """Read the last segment, and those before it from the last one that is indexed on; index them."""
        segments = capsule.segments
        with self.index.reading() as index:
            (last,) = index.execute("SELECT max(offset) FROM checkpoints WHERE capsule = ?", (capsule.name,)).fetchone()
        capsule.chain, found = replayed(capsule.descriptor, segments)
        capsule.damage, capsule.rest = "", b""
        capsule.file_ns = found[0][1].time_ns if found else 0
        for offset in segments.offsets[:-1]:
            size = segments.size_of(offset)
            if last is not None and offset + size <= last:
                continue
            self._index_records(capsule, offset, segments.read(offset, size)[1])
        self._put(capsule, found)

    def _index_records(self, capsule: StoredCapsule, at: int, data: bytes) -> None:
        found = list[IndexedRecord]()
        for wire in split(data):
            record = Record.from_wire(wire)
            if record.type is not RecordType.MESSAGE:
                found.append((at, record, wire))
            at += len(wire)
        self._put(capsule, found)

    def _put(self, capsule: StoredCapsule, found: Sequence[IndexedRecord]) -> None:
        """Index checkpoints, by their offsets, and descriptions and marks, which outlive their segment."""
        if not found:
            return
        name, checkpoints = capsule.name, [(at, of) for at, of, _ in found if of.type is RecordType.CHECKPOINT]
        described = [(name, of.number, wire) for _, of, wire in found if of.type is RecordType.DESCRIPTION]
        marks = [(name, of.number, wire) for _, of, wire in found if of.type is RecordType.MARK]
        with self.index.writing() as index:
            places = [(name, at, each.number, each.time_ns) for at, each in checkpoints]
            index.executemany("INSERT OR REPLACE INTO checkpoints VALUES (?, ?, ?, ?)", places)
            index.executemany("INSERT OR REPLACE INTO descriptions VALUES (?, ?, ?)", described)
            index.executemany("INSERT OR REPLACE INTO marks VALUES (?, ?, ?)", marks)
        if checkpoints and capsule.chain.number:
            capsule.checkpoint = max(capsule.checkpoint, checkpoints[-1][0])
            rank = capsule.checkpoint << _HEAD_BITS | int.from_bytes(capsule.chain.proven, "big") >> 256 - _HEAD_BITS
            self.heads.put(name, rank)


def objects_of(index: TransactionFile, name: Name) -> dict[int, StoredObject]:
    """Return what the bucket was given of a capsule, by offset. Raises ``StoreError``: the index cannot be read."""
    with index.reading() as open_index:
        rows = open_index.execute("SELECT offset, size, tag FROM objects WHERE capsule = ? ORDER BY offset", (name,))
        return {offset: StoredObject(size, tag) for offset, size, tag in rows}


def object_of(index: TransactionFile, name: Name, offset: int) -> StoredObject | None:
    """Return what the bucket was given of one segment. Raises ``StoreError``: the index cannot be read."""
    with index.reading() as open_index:
        query = "SELECT size, tag FROM objects WHERE capsule = ? AND offset = ?"
        row = open_index.execute(query, (name, offset)).fetchone()
    return None if row is None else StoredObject(*row)


def _marks(index: TransactionFile, name: Name) -> list[bytes]:
    """Return the records of the latest marks of a capsule, as many as an answer may have, in order."""
    query = "SELECT wire FROM marks WHERE capsule = ? ORDER BY number DESC LIMIT ?"
    with index.reading() as open_index:
        found = [row[0] for row in open_index.execute(query, (name, _MARKS_MAX))]
    sizes = accumulate(map(len, found))
    return [wire for wire, size in zip(found, sizes, strict=True) if size <= BATCH_BYTES][::-1]


def _described(index: TransactionFile, capsule: StoredCapsule, number: int) -> bytes:
    """Return the latest description of each topic before a record."""
    found, topics = dict[bytes, bytes](), len(capsule.descriptor.topics)
    query = "SELECT wire FROM descriptions WHERE capsule = ? AND number < ? ORDER BY number DESC"
    with index.reading() as open_index:
        for (wire,) in open_index.execute(query, (capsule.name, number)):
            found.setdefault(decode(Record.from_wire(wire).frames[0]).destination, wire)
            if len(found) == topics:
                break
    sizes = accumulate(map(len, found.values()))
    return b"".join(wire for wire, size in zip(found.values(), sizes, strict=True) if size <= BATCH_BYTES)


def index_of(folder: Path) -> TransactionFile:
    """Return the index of a store. Raises ``StoreError``: it cannot be opened."""
    return TransactionFile(folder / "index.db", _TABLE, synchronous="NORMAL")


def marks_of(folder: Path, name: Name) -> list[Record]:
    """Return the latest marks of a capsule in a store. Raises ``StoreError``: the index cannot be read."""
    with index_of(folder) as index:
        return [Record.from_wire(wire) for wire in _marks(index, name)]


def _parties_of(descriptor: Descriptor) -> Sequence[bytes]:
    return [*dict.fromkeys(each.topic.owner_key for each in descriptor.rights), descriptor.writer.name]


def _refuse_others(descriptor: Descriptor, client: Name) -> None:
    if descriptor.writer.name != client:
        raise LocalError(f"{descriptor.name.short}: another node is its writer")


def remove(folder: Path, name: Name) -> None:
    """Remove a capsule from a store whose holder does not run. Raises ``LocalError``: it is not there."""
    place = folder / name.to_text()
    if not (place / DESCRIPTOR).exists():
        raise LocalError(f"{place}: no capsule")
    with index_of(folder) as file, file.writing() as index:
        for table in ("checkpoints", "descriptions", "marks", "objects"):
            index.execute(f"DELETE FROM {table} WHERE capsule = ?", (name,))
    shutil.rmtree(place)
