"""How many bytes unfinished messages may hold, per source and in all.

Place: pure. One budget serves every joiner of a node. Where memory is short, whoever holds most gives way to whoever
holds less, among sources and among the streams of one source: parts made in one publisher's name, which a reader can
make too, leave every other stream its fair part.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol
from weakref import WeakKeyDictionary

from gdp.errors import LocalError
from gdp.limits import JOIN_SOURCE_BYTES, JOIN_TOTAL_BYTES

__all__ = ["QuotaHolder", "ReassemblyQuota"]


class QuotaHolder(Protocol):
    """What keeps unfinished messages, and can give some of them up."""

    @property
    def unfinished_bytes(self) -> int:
        """Return how much it could give back."""

    def give_way(self) -> None:
        """Drop the message that is needed last, and release what it held."""


class ReassemblyQuota:
    """Counts bytes that are held, and refuses what would pass a bound."""

    def __init__(self, total_bytes: int = JOIN_TOTAL_BYTES, source_bytes: int = JOIN_SOURCE_BYTES) -> None:
        self._total_max = total_bytes
        self._source_max = source_bytes
        self._by_source: dict[bytes, int] = {}
        self._holders: WeakKeyDictionary[QuotaHolder, bytes] = WeakKeyDictionary()  # with their sources
        self.held_bytes = 0

    def register(self, holder: QuotaHolder, source: bytes) -> None:
        """Let a holder be asked to give way; it is forgotten with its last reference."""
        self._holders[holder] = source

    def reserve(self, source: bytes, size: int, holder: QuotaHolder | None = None) -> bool:
        """Take ``size`` bytes for a source; False, and nothing taken, when a bound stands against it.

        Args:
            holder: of the source, for which it is; others that hold more than it give way.
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

    def _relieve(self, asker: QuotaHolder | None, source: bytes, above: int) -> bool:
        """Have that holder of a source give way that could give back most, if it is more than ``above`` bytes."""
        others = [each for each, of in self._holders.items() if of == source and each is not asker]
        victim = max(others, key=lambda each: each.unfinished_bytes, default=None)
        if victim is None or victim.unfinished_bytes <= above:
            return False
        victim.give_way()
        return True

    def release(self, source: bytes, size: int) -> None:
        """Give ``size`` bytes back.

        Raises:
            LocalError: more than the source holds.
        """
        left = self._by_source.get(source, 0) - size
        if left < 0:
            raise LocalError("more memory given back than was taken")
        if left:
            self._by_source[source] = left
        else:
            self._by_source.pop(source, None)
        self.held_bytes -= size
