"""Checkpoint of a capsule: the writer's signature over all records since the checkpoint before, and their Merkle tree.

Sans-I/O. Source: RFC 9162, section 2.1 (Merkle tree, inclusion proof). Wire form, the body of a record::

    first (8) | head (32) | root (32) | for each record from ``first``: first 8 bytes of its leaf | signature (64)

``first`` is the number of the checkpoint before, so checkpoints are chained by their trees as well. ``head`` is the end
of the hash chain over all records before this one. The signature is ECDSA P-256 over ``gdp-capsule-checkpoint-1``, the
capsule's name, number and time of the record, and the body without the signature. The leaves' first bytes let a damage
be named that the root only shows.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from gdp.capsule.record import Record
from gdp.crypto.keys import SIGNATURE_BYTES, PublicKey, SigningKey
from gdp.errors import DropReason, RemoteError
from gdp.names import Name

HINT_BYTES: Final = 8
_HEAD: Final = struct.Struct("!Q32s32s")
_PLACE: Final = struct.Struct("!QQ")
_DOMAIN: Final = b"gdp-capsule-checkpoint-1"
_EMPTY: Final = hashlib.sha256(b"").digest()


class Checkpoint(NamedTuple):
    """A checkpoint as read.

    Attributes:
        first: number of the first record that it covers; it covers all up to itself.
        head: end of the hash chain over all records before it.
        root: of the Merkle tree over what it covers.
        hints: first bytes of each leaf.
    """

    first: int
    head: bytes
    root: bytes
    hints: tuple[bytes, ...]
    signature: bytes

    @classmethod
    def from_record(cls, record: Record) -> Checkpoint:
        """Read the body of a record. Raises ``RemoteError``: MALFORMED."""
        body, end = record.body, len(record.body) - SIGNATURE_BYTES
        if end < _HEAD.size or (end - _HEAD.size) % HINT_BYTES:
            raise RemoteError(DropReason.MALFORMED, "checkpoint")
        first, head, root = _HEAD.unpack_from(body)
        hints = tuple(body[at : at + HINT_BYTES] for at in range(_HEAD.size, end, HINT_BYTES))
        if first + len(hints) != record.number:
            raise RemoteError(DropReason.MALFORMED, "checkpoint over other records than it says")
        return cls(first, head, root, hints, body[end:])

    @staticmethod
    def make(
        name: Name, place: tuple[int, int], first: int, head: bytes, leaves: Sequence[bytes], key: SigningKey
    ) -> bytes:
        """Return the body of a checkpoint; ``place``: number and time of its record."""
        body = _HEAD.pack(first, head, root_of(leaves)) + b"".join([leaf[:HINT_BYTES] for leaf in leaves])
        return body + key.sign(_DOMAIN + name + _PLACE.pack(*place) + body)

    def verify(self, name: Name, record: Record, key: PublicKey) -> None:
        """Return if the writer signed it. Raises ``StatementError``: BAD_SIGNATURE."""
        place = _PLACE.pack(record.number, record.time_ns)
        key.verify(self.signature, _DOMAIN + name + place + record.body[:-SIGNATURE_BYTES])


def root_of(leaves: Sequence[bytes]) -> bytes:
    """Return the root of the Merkle tree over leaves."""
    if len(leaves) < 2:
        return leaves[0] if leaves else _EMPTY
    half = _half(len(leaves))
    return _node(root_of(leaves[:half]), root_of(leaves[half:]))


def proof_of(leaves: Sequence[bytes], index: int) -> list[bytes]:
    """Return the hashes that prove a leaf's place, those next to it first."""
    if len(leaves) < 2:
        return []
    half = _half(len(leaves))
    if index < half:
        return [*proof_of(leaves[:half], index), root_of(leaves[half:])]
    return [*proof_of(leaves[half:], index - half), root_of(leaves[:half])]


def proven_root(leaf: bytes, index: int, count: int, proof: Sequence[bytes]) -> bytes:
    """Return the root of the tree of ``count`` leaves in which a leaf has this index, by its proof.

    Raises:
        RemoteError: MALFORMED, a proof of another length.
    """
    if count < 2 or not proof:
        if proof or count != 1 or index:
            raise RemoteError(DropReason.MALFORMED, "a proof of another length")
        return leaf
    half = _half(count)
    if index < half:
        return _node(proven_root(leaf, index, half, proof[:-1]), proof[-1])
    return _node(proof[-1], proven_root(leaf, index - half, count - half, proof[:-1]))


def _half(count: int) -> int:
    """Return the largest power of two below ``count``."""
    return 1 << (count - 1).bit_length() - 1


def _node(left: bytes, right: bytes) -> bytes:
    return hashlib.sha256(b"\1" + left + right).digest()
