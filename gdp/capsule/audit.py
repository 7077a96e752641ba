"""Audit of a capsule: each damage of the stored bytes is found, and named by the numbers of its records.

Sans-I/O. An audit needs the writer's key alone. It continues behind a damage: a checkpoint states first bytes of the
hash of each record that it covers, so the records around the damaged one stay proven.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from gdp.capsule.checkpoint import HINT_BYTES, Checkpoint, root_of
from gdp.capsule.opening import verify_frames
from gdp.capsule.record import Record, RecordType, find, leaf_of, size_of
from gdp.capsule.windows import Mark
from gdp.crypto.keys import PublicKey
from gdp.errors import RemoteError
from gdp.names import Name


class Damage(str, Enum):
    """What is wrong with records."""

    ALTERED = "altered"  # other bytes than the writer signed
    REMOVED = "removed"
    REORDERED = "reordered"
    DUPLICATED = "duplicated"
    FORKED = "forked"  # two records of one number, or another checkpoint than one that is known
    ROLLED_BACK = "rolled-back"  # a checkpoint that is known is beyond the end
    UNPROVEN = "unproven"  # the checkpoint over them is damaged, or not here


class Finding(NamedTuple):
    """Damage of the records ``first`` to ``last``, both included."""

    damage: Damage
    first: int
    last: int
    detail: str = ""

    def words(self) -> str:
        """Return it as a line."""
        which = f"record {self.first}" if self.first == self.last else f"records {self.first} to {self.last}"
        return f"{which}: {self.damage.value}{f' ({self.detail})' if self.detail else ''}"


class Audit:
    """Audit of one capsule.

    Args:
        known: a record with a checkpoint that came from elsewhere, such as another holder; None: there is none.
        is_deep: also verify the signature of each message.

    Attributes:
        findings: damages, in the order of detection.
        records: undamaged ones.
        proven: number of the last checkpoint of the writer.
        begin: number of the first record; where it is above 0, the records before it are not here.
        gaps: records without a cause yet, by the number of the checkpoint behind them.
        left_out: records between windows, which the writer did not upload, in the same way.
    """

    def __init__(self, name: Name, key: PublicKey, *, known: bytes | None = None, is_deep: bool = False) -> None:
        self._name = name
        self._key = key
        self._known = None if known is None else Record.from_wire(known)
        self._known_leaf = b"" if known is None else leaf_of(known)
        self._is_deep = is_deep
        self._found: dict[tuple[Damage, int], Finding] = {}
        self._leaves: dict[int, bytes] = {}  # of this interval and of the one before
        self._missing: dict[int, Damage] = {}
        self._next = 0
        self._has_begun = False
        self._is_broken = False  # bytes before the next record are no record
        self.begin = self.proven = self.records = 0
        self.gaps: dict[int, range] = {}
        self.left_out: dict[int, range] = {}
        self._late: set[int] = set()  # records of gaps that came later
        self._time_ns = self._window_ns = 0  # of the last record; end of the windows so far
        self._mark = 0  # number of the last mark

    @property
    def findings(self) -> list[Finding]:
        """Return what was found so far."""
        return sorted(self._found.values(), key=lambda each: (each.first, each.damage.value))

    def add(self, data: bytes) -> None:
        """Read the next segment, or the next bytes that begin and end with a record."""
        at = 0
        while at < len(data):
            begin = find(data, at)
            if begin != at:
                self.skip()
            if begin is None:
                return
            at = begin + size_of(data, begin)
            self.handle_record(data[begin:at])

    def skip(self) -> None:
        """Note that bytes here are no record."""
        self._is_broken = True

    def finish(self) -> list[Finding]:
        """Return all findings, once everything was added."""
        if self._is_broken:
            self._find(Damage.ALTERED, self._next, self._next, "bytes behind the last record")
        for number in [each for gap in self.gaps.values() for each in gap if each not in self._late]:
            self._find(Damage.REMOVED, number, number)
        for number, damage in self._missing.items():
            self._find(damage, number, number)
        known = self._known
        if known is not None and known.number >= self._next:
            detail = f"a checkpoint {known.number} of the writer is known"
            self._find(Damage.ROLLED_BACK, self._next, known.number, detail)
        return self.findings

    def handle_record(self, wire: bytes) -> None:
        """Check the next record whose checksum is right. Raises ``RemoteError``: it is none."""
        record, leaf = Record.from_wire(wire), leaf_of(wire)
        number = record.number
        if not self._has_begun:
            self._has_begun = True
            if record.type is RecordType.CHECKPOINT and not self._is_broken:
                self._next = self.begin = self.proven = number
        if number < self._next:
            self._handle_late(number, leaf)
            return
        is_gap = self._is_gap(record)
        if is_gap:
            self.gaps[number] = range(self._next, number)
        for each in () if is_gap else range(self._next, number):
            self._missing[each] = Damage.ALTERED if self._is_broken else Damage.REMOVED
        if self._is_broken and number == self._next:
            self._find(Damage.ALTERED, number, number, "bytes before it that are no record")
        self._is_broken = False
        self._next = number + 1
        self._leaves[number] = leaf
        self.records += 1
        if self._known is not None and number == self._known.number and leaf != self._known_leaf:
            self._find(Damage.FORKED, number, number, "the writer signed another checkpoint of this number")
        self._time_ns = record.time_ns
        if record.type is RecordType.CHECKPOINT:
            self._judge(record, is_first=is_gap or number == self.begin)
        elif self._is_deep:
            self._verify(record)
        if record.type is RecordType.MARK:
            self._handle_mark(record)

    def _is_gap(self, record: Record) -> bool:
        """Return whether a window may begin with a record: it is a checkpoint, and one ended the window before."""
        is_checkpoint = record.type is RecordType.CHECKPOINT and self.proven == self._next - 1
        return record.number > self._next and is_checkpoint and self._time_ns >= self._window_ns and not self._is_broken

    def _handle_mark(self, record: Record) -> None:
        try:
            mark = Mark.from_record(record)
        except RemoteError as error:
            self._find(Damage.ALTERED, record.number, record.number, str(error))
            return
        if self.begin < mark.previous != self._mark:
            self._find(Damage.REMOVED, mark.previous, mark.previous, "a mark, with its window")
        if mark.first in self.gaps:
            self.left_out[mark.first] = self.gaps.pop(mark.first)
        self._mark, self._window_ns = record.number, max(self._window_ns, mark.to_ns)

    def _handle_late(self, number: int, leaf: bytes) -> None:
        known = self._leaves.get(number)
        if known == leaf:
            self._find(Damage.DUPLICATED, number, number)
        elif known is not None:
            self._find(Damage.FORKED, number, number, "another record has the same number")
        else:
            self._missing.pop(number, None)
            self._late.add(number)
            self._found.pop((Damage.REMOVED, number), None)
            self._leaves[number] = leaf
            self._find(Damage.REORDERED, number, self._next - 1)

    def _verify(self, record: Record) -> None:
        try:
            for frames in record.sealed:
                verify_frames(frames, self._key)
        except RemoteError as error:
            self._find(Damage.ALTERED, record.number, record.number, str(error))

    def _judge(self, record: Record, *, is_first: bool) -> None:
        """Compare a checkpoint with the records that it covers, unless it is the first here, or behind a gap."""
        number = record.number
        try:
            checkpoint = Checkpoint.from_record(record)
            checkpoint.verify(self._name, record, self._key)
        except RemoteError as error:
            self._find(Damage.ALTERED, number, number, f"not signed by the writer: {error}")
            return
        if is_first:
            self.proven, self._leaves = number, {number: self._leaves[number]}
            return
        if checkpoint.first > self.proven:
            self._find_unproven(checkpoint.first)
        before = len(self._found)
        for each, hint in enumerate(checkpoint.hints, checkpoint.first):
            leaf = self._leaves.get(each)
            if leaf is None:
                self._find(self._missing.pop(each, Damage.REMOVED), each, each)
            elif leaf[:HINT_BYTES] != hint:
                self._find(Damage.ALTERED, each, each, "the writer signed another one")
        leaves = [self._leaves.get(each, b"") for each in range(checkpoint.first, number)]
        if len(self._found) == before and root_of(leaves) != checkpoint.root:
            self._find(Damage.ALTERED, checkpoint.first, number - 1, "the writer signed another tree")
        self.proven = number
        self._leaves = {each: leaf for each, leaf in self._leaves.items() if each >= checkpoint.first}

    def _find_unproven(self, end: int) -> None:
        for number in [each for each in self._missing if each < end]:
            self._find(self._missing.pop(number), number, number)
        unproven = [number for number in self._leaves if self.proven < number < end]
        if unproven:
            self._find(Damage.UNPROVEN, min(unproven), max(unproven), "the checkpoint over them is not here")

    def _find(self, damage: Damage, first: int, last: int, detail: str = "") -> None:
        self._found.setdefault((damage, first), Finding(damage, first, last, detail))
