"""How many bytes unfinished messages may hold, per source and in all.

Place: pure. One budget serves every joiner of a node.
"""

from __future__ import annotations

from gdp.errors import LocalError
from gdp.limits import JOIN_SOURCE_BYTES, JOIN_TOTAL_BYTES

__all__ = ["Budget"]


class Budget:
    """Counts bytes that are held, and refuses what would pass a bound."""

    def __init__(self, total_bytes: int = JOIN_TOTAL_BYTES, source_bytes: int = JOIN_SOURCE_BYTES) -> None:
        self._total_max = total_bytes
        self._source_max = source_bytes
        self._by_source: dict[bytes, int] = {}
        self.held_bytes = 0

    def reserve(self, source: bytes, size: int) -> bool:
        """Take ``size`` bytes for a source; False, and nothing taken, when a bound stands against it."""
        mine = self._by_source.get(source, 0) + size
        if mine > self._source_max or self.held_bytes + size > self._total_max:
            return False
        self._by_source[source] = mine
        self.held_bytes += size
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
