"""Bytes of clients' messages that have not come whole: their sum is bounded, and a slow sender gives way."""

from __future__ import annotations

from typing import Final, Generic, TypeVar

_KeyT = TypeVar("_KeyT")
_SMALL_BYTES: Final = 64 << 10  # heartbeats and short messages, which say nothing of when a long one began


class Arrivals(Generic[_KeyT]):
    """Messages on their way, by connection; those that have been long on their way come first.

    Args:
        max_bytes: bound of their sum.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._held_bytes = 0
        self._begun: dict[_KeyT, int] = {}  # to bytes

    def count(self, key: _KeyT, size_bytes: int) -> list[_KeyT]:
        """Count bytes of a connection; return those to end, so that the sum is within its bound.

        They are those whose message began first, of those that hold no less than the mean.
        """
        before = self._begun.get(key, 0)
        if before <= _SMALL_BYTES:
            self._begun.pop(key, None)  # to the end of the order
        self._begun[key] = before + size_bytes
        self._held_bytes += size_bytes
        ended: list[_KeyT] = []
        while self._held_bytes > self._max_bytes:
            mean_bytes = self._held_bytes / len(self._begun)
            ended.append(next(each for each, held in self._begun.items() if held >= mean_bytes))
            self.end(ended[-1])
        return ended

    def end(self, key: _KeyT) -> None:
        """Forget a connection's bytes: its message is whole, or it is gone."""
        self._held_bytes -= self._begun.pop(key, 0)
