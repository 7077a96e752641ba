"""Reassembly quota: the memory that unfinished messages may use, per source and in all.

Sans-I/O. Source: Linux ``ipfrag_high_thresh``. One quota serves every reassembler of a node. Where memory is short, the
largest holder releases memory for a smaller one, among sources and among the streams of one source. So fragments in one
publisher's name, which a reader can make too, leave every other stream its fair share.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol
from weakref import WeakKeyDictionary

from gdp.errors import LocalError
from gdp.limits import JOIN_SOURCE_BYTES, JOIN_TOTAL_BYTES


class QuotaHolder(Protocol):
    """Holder of unfinished messages, some of which it can drop."""

    @property
    def unfinished_bytes(self) -> int:
        """Return how many bytes it could release."""

    def give_way(self) -> None:
        """Drop the message that is needed last, and release its memory."""


class ReassemblyQuota:
    """Counter of reserved bytes that refuses to pass a bound."""

    def __init__(self, total_bytes: int = JOIN_TOTAL_BYTES, source_bytes: int = JOIN_SOURCE_BYTES) -> None:
        self._total_max = total_bytes
        self._source_max = source_bytes
        self._by_source: dict[bytes, int] = {}
        self._holders: WeakKeyDictionary[QuotaHolder, bytes] = WeakKeyDictionary()  # with their sources
        self.held_bytes = 0

    def register(self, holder: QuotaHolder, source: bytes) -> None:
        """Register a holder that may have to release memory; it is forgotten with its last reference."""
        self._holders[holder] = source

    def reserve(self, source: bytes, size: int, holder: QuotaHolder | None = None) -> bool:
        """Reserve ``size`` bytes for a source; return False, and reserve nothing, if that would pass a bound.

        Args:
            holder: of the source, the one that needs the bytes; others that hold more than it release theirs.
        """
        while self._by_source.get(source, 0) + size > self._source_max:
            if holder is None or not self._relieve(holder, source, holder.unfinished_bytes + size):
                return False
        while self.held_bytes + size > self._total_max:
            others = self._larger_sources(self._by_source.get(source, 0) + size)
            if not any(self._relieve(None, other, 0) for other in others):
                return False
        self._by_source[source] = self._by_source.get(source, 0) + size
        self.held_bytes += size
        return True

    def _larger_sources(self, size: int) -> Collection[bytes]:
        """Return the sources that hold more than ``size``, the largest first."""
        larger = [source for source, held in self._by_source.items() if held > size]
        return sorted(larger, key=lambda source: -self._by_source[source])

    def _relieve(self, asker: QuotaHolder | None, source: bytes, upstream: int) -> bool:
        """Release memory of the source's largest holder, if that could release more than ``upstream`` bytes."""
        others = [each for each, of in self._holders.items() if of == source and each is not asker]
        victim = max(others, key=lambda each: each.unfinished_bytes, default=None)
        if victim is None or victim.unfinished_bytes <= upstream:
            return False
        victim.give_way()
        return True

    def release(self, source: bytes, size: int) -> None:
        """Release ``size`` bytes. Raises ``LocalError``: more than the source holds."""
        left = self._by_source.get(source, 0) - size
        if left < 0:
            raise LocalError("more memory given back than was taken")
        if left:
            self._by_source[source] = left
        else:
            self._by_source.pop(source, None)
        self.held_bytes -= size
