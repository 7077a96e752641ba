"""Chain of a capsule's records: its writer extends it, and who receives records checks that they extend it.

Sans-I/O; time comes in as Unix nanoseconds. The chain begins with a checkpoint over nothing. Each segment begins with a
checkpoint, too, so a segment alone is verified from the state that its first record signs.

    head of nothing = SHA-256("gdp-capsule-1" || name);   head after a record = SHA-256(head before || leaf)
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final

from gdp.capsule.checkpoint import Checkpoint, root_of
from gdp.capsule.record import Record, RecordType, body_of, leaf_of
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.errors import DropReason, RemoteError
from gdp.names import Name

CHECKPOINT_BYTES: Final = 1 << 20  # of records, after which a checkpoint is due
CHECKPOINT_NS: Final = 1_000_000_000  # ... or this long after the first of them


class Chain:
    """State after the records so far.

    Args:
        name: of the capsule.
        key: the writer's.

    Attributes:
        number: of the next record.
        first: number of the last checkpoint.
        head: end of the hash chain.
        proven: the same behind the last checkpoint.
        leaves: hashes of the records from the last checkpoint on.
        time_ns: of the last record.
    """

    def __init__(self, name: Name, key: PublicKey) -> None:
        self.name = name
        self._key = key
        self.number = self.first = self.time_ns = 0
        self.head = self.proven = hashlib.sha256(b"gdp-capsule-1" + name).digest()
        self.leaves: list[bytes] = []

    def handle_record(self, wire: bytes, *, may_skip: bool = False) -> Record:
        """Check the next record, and extend the chain by it.

        Args:
            may_skip: a checkpoint of a later number may follow: records in between never came.

        Raises:
            RemoteError: MALFORMED, BAD_SIGNATURE, or not the next record; nothing has changed.
        """
        record = Record.from_wire(wire)
        is_later = may_skip and record.number > self.number and record.type is RecordType.CHECKPOINT
        if record.number != self.number and not is_later:
            raise RemoteError(DropReason.MALFORMED, f"record {record.number} where {self.number} is next")
        if record.time_ns < self.time_ns:
            raise RemoteError(DropReason.MALFORMED, f"record {record.number} is older than the one before")
        if record.type is RecordType.CHECKPOINT:
            self._check(record, is_later=is_later)
        elif not self.number:
            raise RemoteError(DropReason.MALFORMED, "a capsule that does not begin with a checkpoint")
        self.extend(record, wire)
        return record

    def _check(self, record: Record, *, is_later: bool) -> None:
        checkpoint = Checkpoint.from_record(record)
        checkpoint.verify(self.name, record, self._key)
        if is_later:
            self.head = checkpoint.head
        elif (checkpoint.first, checkpoint.head) != (self.first, self.head) or checkpoint.root != root_of(self.leaves):
            raise RemoteError(DropReason.MALFORMED, f"checkpoint {record.number} is signed over other records: a fork")

    def extend(self, record: Record, wire: bytes) -> None:
        """Extend the chain by a record that was checked, or is made here."""
        leaf = leaf_of(wire)
        self.head = hashlib.sha256(self.head + leaf).digest()
        if record.type is RecordType.CHECKPOINT:
            self.leaves, self.first, self.proven = [], record.number, self.head
        self.leaves.append(leaf)
        self.number, self.time_ns = record.number + 1, record.time_ns


class ChainWriter:
    """Makes the records of one capsule.

    Args:
        chain: state after the records that exist.
        key: the writer's private key.
    """

    def __init__(self, chain: Chain, key: SigningKey) -> None:
        self.chain = chain
        self._signer = key
        self._bytes = 0
        self._since_ns = 0  # time of the first record without a checkpoint

    def append(
        self, type_: RecordType, time_ns: int, frames: Sequence[bytes], sequence: int = 0, messages: int = 0
    ) -> bytes:
        """Return the next record, with these frames."""
        is_first = not self.has_new
        wire = self._make(type_, time_ns, body_of(frames), sequence, messages)
        self._bytes += len(wire)
        if is_first:
            self._since_ns = self.chain.time_ns
        return wire

    @property
    def has_new(self) -> bool:
        """Return whether there are records without a checkpoint."""
        return len(self.chain.leaves) > 1

    def is_due(self, time_ns: int) -> bool:
        """Return whether a checkpoint is due: the very first, or one over new records."""
        is_long = self._bytes >= CHECKPOINT_BYTES or time_ns - self._since_ns >= CHECKPOINT_NS
        return not self.chain.number or (self.has_new and is_long)

    def checkpoint(self, time_ns: int) -> bytes:
        """Return a checkpoint over all records since the last."""
        chain = self.chain
        time_ns = max(time_ns, chain.time_ns)
        body = Checkpoint.make(chain.name, (chain.number, time_ns), chain.first, chain.head, chain.leaves, self._signer)
        self._bytes = 0
        return self._make(RecordType.CHECKPOINT, time_ns, body)

    def _make(self, type_: RecordType, time_ns: int, body: bytes, sequence: int = 0, messages: int = 0) -> bytes:
        chain = self.chain
        record = Record(type_, chain.number, max(time_ns, chain.time_ns), sequence, messages, body)
        wire = record.to_wire()
        chain.extend(record, wire)
        return wire
