"""Cache of decoders for remote publishers' descriptions, bounded by number and bytes, also for each publisher.

Sans-I/O. The least recently used entry is dropped first. A publisher that changes its description again and again
evicts its own entries, not those of others.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import Final, Generic, TypeVar

_COUNT_MAX: Final = 1_024
_BYTES_MAX: Final = 16 << 20  # of descriptions
_EACH_MAX: Final = 8  # descriptions of one publisher of one topic
_OVERHEAD_BYTES: Final = 2_048

_Ready = TypeVar("_Ready")


class DecoderCache(Generic[_Ready]):
    """Entries by publisher and description; None is the entry of a description that was refused.

    Args:
        bytes_max: of their descriptions, with some overhead; the newest entry stays whatever its length.
    """

    def __init__(self, count_max: int = _COUNT_MAX, bytes_max: int = _BYTES_MAX, each_max: int = _EACH_MAX) -> None:
        self._count_max = count_max
        self._bytes_max = bytes_max
        self._each_max = each_max
        self._entries: OrderedDict[tuple[bytes, bytes], _Ready | None] = OrderedDict()
        self._of: Counter[bytes] = Counter()
        self.held_bytes = 0

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, key: tuple[bytes, bytes]) -> bool:
        """Return whether there is an entry for (publisher, description)."""
        return key in self._entries

    def get(self, publisher: bytes, description: bytes) -> _Ready | None:
        """Return the entry, None for a refused or unknown description; this counts as a use."""
        key = (publisher, description)
        if key not in self._entries:
            return None
        self._entries.move_to_end(key)
        return self._entries[key]

    def put(self, publisher: bytes, description: bytes, ready: _Ready | None) -> None:
        """Add an entry, and drop others beyond the bounds."""
        key = (publisher, description)
        if key in self._entries:
            self._remove(key)
        self._entries[key] = ready
        self._of[publisher] += 1
        self.held_bytes += len(description) + _OVERHEAD_BYTES
        if self._of[publisher] > self._each_max:
            self._remove(next(each for each in self._entries if each[0] == publisher))
        while len(self._entries) > 1 and (len(self._entries) > self._count_max or self.held_bytes > self._bytes_max):
            self._remove(next(iter(self._entries)))

    def forget_refused(self) -> None:
        """Drop the refused entries, so that they are checked again."""
        for key in [key for key, ready in self._entries.items() if ready is None]:
            self._remove(key)

    def _remove(self, key: tuple[bytes, bytes]) -> None:
        del self._entries[key]
        publisher, description = key
        self._of[publisher] -= 1
        if not self._of[publisher]:
            del self._of[publisher]
        self.held_bytes -= len(description) + _OVERHEAD_BYTES
