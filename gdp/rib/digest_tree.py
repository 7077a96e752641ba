"""Digest tree over the names that a RIB stores, updated with each change: equal hashes mean equal contents.

Sans-I/O. Two levels of 256 by the first two bytes of the name. A hash is the exclusive or of its entries' hashes, so
that one change costs three of them, in any order.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Iterator
from hashlib import blake2b
from typing import Final

from gdp.control.rib_replication import FANOUT, HASH_BYTES, Item, Key
from gdp.names import Name

__all__ = ["DigestTree"]

_LEAVES: Final = FANOUT * FANOUT


class DigestTree:
    """Entries by the first two bytes of their name, and the hashes over them."""

    def __init__(self) -> None:
        self._entries: dict[int, dict[Key, tuple[int, bool]]] = {}
        self._leaves = array("Q", bytes(HASH_BYTES * _LEAVES))
        self._buckets = array("Q", bytes(HASH_BYTES * FANOUT))
        self._counts = [0] * FANOUT
        self._total = 0

    @property
    def total(self) -> bytes:
        """Return the hash over everything, 8 bytes."""
        return self._total.to_bytes(HASH_BYTES, "big")

    def put(self, name: Name, advertiser: Name, sequence: int, *, is_withdrawn: bool) -> None:
        """Add or replace an entry."""
        self.remove(name, advertiser)
        leaf = int.from_bytes(name[:2], "big")
        self._entries.setdefault(leaf, {})[name, advertiser] = (sequence, is_withdrawn)
        self._counts[leaf >> 8] += 1
        self._flip(leaf, _hash(name, advertiser, sequence, is_withdrawn))

    def remove(self, name: Name, advertiser: Name) -> None:
        """Remove an entry, if it is there."""
        leaf = int.from_bytes(name[:2], "big")
        entries = self._entries.get(leaf)
        known = None if entries is None else entries.pop((name, advertiser), None)
        if known is None:
            return
        if not entries:
            del self._entries[leaf]
        self._counts[leaf >> 8] -= 1
        self._flip(leaf, _hash(name, advertiser, *known))

    def count(self, prefix: bytes) -> int:
        """Return how many entries lie below a prefix of up to 2 bytes."""
        if not prefix:
            return sum(self._counts)
        return (
            self._counts[prefix[0]] if len(prefix) == 1 else len(self._entries.get(int.from_bytes(prefix, "big"), ()))
        )

    def hashes(self, prefix: bytes) -> bytes:
        """Return the 256 hashes below a prefix of up to 1 byte, one after the other."""
        found = self._leaves[prefix[0] * FANOUT : (prefix[0] + 1) * FANOUT] if prefix else self._buckets[:]
        if sys.byteorder == "little":
            found.byteswap()
        return found.tobytes()

    def differing(self, prefix: bytes, hashes: bytes) -> list[bytes]:
        """Return the longer prefixes whose hash differs from the one in ``hashes``, 256 of them."""
        own = self.hashes(prefix)
        at = range(0, len(own), HASH_BYTES)
        return [
            prefix + bytes([index])
            for index, begin in enumerate(at)
            if own[begin : begin + HASH_BYTES] != hashes[begin : begin + HASH_BYTES]
        ]

    def items(self, prefix: bytes) -> Iterator[Item]:
        """Yield the entries below a prefix of up to 2 bytes."""
        first = int.from_bytes(prefix.ljust(2, b"\0"), "big")
        leaves = range(first, first + (1 << 8 * (2 - len(prefix)))) if prefix else list(self._entries)
        for leaf in leaves:
            for (name, advertiser), (sequence, is_withdrawn) in self._entries.get(leaf, {}).items():
                yield Item(name, advertiser, sequence, is_withdrawn)

    def _flip(self, leaf: int, hashed: int) -> None:
        self._leaves[leaf] ^= hashed
        self._buckets[leaf >> 8] ^= hashed
        self._total ^= hashed


def _hash(name: Name, advertiser: Name, sequence: int, is_withdrawn: bool) -> int:
    hashed = blake2b(name, digest_size=HASH_BYTES)
    hashed.update(advertiser)
    hashed.update(sequence.to_bytes(9, "big"))
    hashed.update(b"\1" if is_withdrawn else b"\0")
    return int.from_bytes(hashed.digest(), "big")
