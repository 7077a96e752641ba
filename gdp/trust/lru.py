"""LRU cache of verified statements, bounded in size."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

_V = TypeVar("_V")


class Lru(Generic[_V]):
    """A mapping from bytes to values that never holds more than ``maximum``."""

    __slots__ = ("_items", "_maximum")

    def __init__(self, maximum: int) -> None:
        self._items: OrderedDict[bytes, _V] = OrderedDict()
        self._maximum = maximum

    def get(self, key: bytes) -> _V | None:
        """Return the value, which is now the most recently used, or None."""
        value = self._items.get(key)
        if value is not None:
            self._items.move_to_end(key)
        return value

    def put(self, key: bytes, value: _V) -> None:
        """Store a value."""
        self._items[key] = value
        self._items.move_to_end(key)
        if len(self._items) > self._maximum:
            self._items.popitem(last=False)

    def values(self) -> list[_V]:
        """Return all values, the least recently used first."""
        return list(self._items.values())

    def __len__(self) -> int:
        return len(self._items)
