"""Set of items that two nodes compare by hashes: equal hashes mean equal contents.

Sans-I/O. Source: Merkle tree of a replica (DeCandia et al., Dynamo, 2007, section 4.7). Two levels of 256 by the first
two bytes of the key. A hash is the exclusive or of its items' hashes, so that one change costs three of them, in any
order. Keys begin with a hash of something, a name or a fingerprint, so that the tree is even.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Final, Generic, TypeVar

FANOUT: Final = 256
HASH_BYTES: Final = 8
PREFIX_MAX_BYTES: Final = 2  # of a prefix that has hashes below it, or is a leaf
_RANK_BYTES: Final = 9
LINE_BYTES: Final = HASH_BYTES + _RANK_BYTES

V = TypeVar("V")


@dataclass(slots=True)
class _Bucket(Generic[V]):
    """Items whose keys have one first byte, by the second."""

    leaves: dict[int, dict[bytes, V]] = field(default_factory=dict)
    hashes: array[int] = field(default_factory=lambda: array("Q", bytes(HASH_BYTES * FANOUT)))
    hash: int = 0
    count: int = 0


class SyncSet(Generic[V]):
    """Items by key, and the hashes over their keys and ranks.

    Args:
        rank_of: returns the rank of a value, 0 to 2^72-1: of two items with one key the higher one counts.
    """

    def __init__(self, rank_of: Callable[[V], int]) -> None:
        self._rank_of = rank_of
        self._buckets: dict[int, _Bucket[V]] = {}
        self._total = 0
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[bytes]:
        return (key for key, _ in self._items(b""))

    def get(self, key: bytes) -> V | None:
        """Return the value of a key, or None."""
        bucket = self._buckets.get(key[0])
        return None if bucket is None else bucket.leaves.get(key[1], {}).get(key)

    def put(self, key: bytes, value: V) -> None:
        """Add or replace an item; the key has two bytes or more."""
        self.remove(key)
        bucket = self._buckets.setdefault(key[0], _Bucket())
        bucket.leaves.setdefault(key[1], {})[key] = value
        self._change(bucket, key, value, 1)

    def remove(self, key: bytes) -> V | None:
        """Remove an item and return its value, or None."""
        bucket = self._buckets.get(key[0])
        leaf = {} if bucket is None else bucket.leaves.get(key[1], {})
        if bucket is None or key not in leaf:
            return None
        value = leaf.pop(key)
        if not leaf:
            del bucket.leaves[key[1]]
        self._change(bucket, key, value, -1)
        if not bucket.count:
            del self._buckets[key[0]]
        return value

    @property
    def total(self) -> bytes:
        """Return the hash over everything, ``HASH_BYTES``; zeros for nothing."""
        return self._total.to_bytes(HASH_BYTES, "big")

    def count(self, prefix: bytes) -> int:
        """Return how many items lie below a prefix."""
        if not prefix:
            return self._count
        bucket = self._buckets.get(prefix[0])
        if bucket is None or len(prefix) == 1:
            return 0 if bucket is None else bucket.count
        return sum(1 for _ in self._items(prefix))

    def hashes(self, prefix: bytes) -> bytes:
        """Return the 256 hashes below a prefix of up to 1 byte, one after the other; zeros where nothing is."""
        if prefix:
            bucket = self._buckets.get(prefix[0])
            found = array("Q", bytes(HASH_BYTES * FANOUT)) if bucket is None else bucket.hashes[:]
        else:
            buckets = (self._buckets.get(at) for at in range(FANOUT))
            found = array("Q", [0 if each is None else each.hash for each in buckets])
        if sys.byteorder == "little":
            found.byteswap()
        return found.tobytes()

    def lacking(self, prefix: bytes, hashes: bytes) -> list[bytes]:
        """Return the longer prefixes below which the holder of 256 other ``hashes`` may have more than is here."""
        own = self.hashes(prefix)
        found = []
        for index in range(FANOUT):
            theirs = hashes[index * HASH_BYTES : (index + 1) * HASH_BYTES]
            if any(theirs) and theirs != own[index * HASH_BYTES : (index + 1) * HASH_BYTES]:
                found.append(prefix + bytes([index]))
        return found

    def lines(self, prefix: bytes) -> bytes:
        """Return a line of each item below a prefix: hash of the key (8 bytes), rank (9)."""
        return b"".join(line_of(key, self._rank_of(value)) for key, value in self._items(prefix))

    def newer(self, prefix: bytes, lines: bytes) -> list[bytes]:
        """Return the keys below a prefix whose items are not in these lines, or only with a lower rank."""
        if not lines:
            return [key for key, _ in self._items(prefix)]
        found = [lines[at : at + LINE_BYTES] for at in range(0, len(lines), LINE_BYTES)]
        known = {line[:HASH_BYTES]: rank_in(line) for line in found}
        return [key for key, value in self._items(prefix) if known.get(_short(key), -1) < self._rank_of(value)]

    def _items(self, prefix: bytes) -> Iterator[tuple[bytes, V]]:
        """Yield the items below a prefix of any length."""
        buckets = [self._buckets[prefix[0]]] if prefix and prefix[0] in self._buckets else []
        for bucket in buckets if prefix else self._buckets.values():
            if len(prefix) < PREFIX_MAX_BYTES:
                for leaf in bucket.leaves.values():
                    yield from leaf.items()
            else:
                yield from (each for each in bucket.leaves.get(prefix[1], {}).items() if each[0].startswith(prefix))

    def _change(self, bucket: _Bucket[V], key: bytes, value: V, count: int) -> None:
        rank = self._rank_of(value).to_bytes(_RANK_BYTES, "big")
        hashed = int.from_bytes(blake2b(key + rank, digest_size=HASH_BYTES).digest(), "big")
        bucket.hashes[key[1]] ^= hashed
        bucket.hash ^= hashed
        bucket.count += count
        self._total ^= hashed
        self._count += count


def line_of(key: bytes, rank: int) -> bytes:
    """Return the line of an item, ``LINE_BYTES``."""
    return _short(key) + rank.to_bytes(_RANK_BYTES, "big")


def rank_in(line: bytes) -> int:
    """Return the rank in a line; 0 in none."""
    return int.from_bytes(line[HASH_BYTES:LINE_BYTES], "big")


def _short(key: bytes) -> bytes:
    return blake2b(key, digest_size=HASH_BYTES).digest()
