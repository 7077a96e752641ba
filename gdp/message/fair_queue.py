"""A queue in which each of those who fill it has its turn, however much one of them puts in.

Sans-I/O. Source: J. Nagle, On Packet Switches With Infinite Storage, RFC 970.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Generic, TypeVar

__all__ = ["FairQueue"]

_T = TypeVar("_T")


class FairQueue(Generic[_T]):
    """Items by their owners; one of each owner in turn, the oldest first. It has no bound of its own."""

    __slots__ = ("_length", "_of")

    def __init__(self) -> None:
        self._of: OrderedDict[bytes, deque[_T]] = OrderedDict()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def put(self, owner: bytes, item: _T) -> None:
        """Put an item behind the others of its owner."""
        self._of.setdefault(owner, deque()).append(item)
        self._length += 1

    def pop(self) -> _T:
        """Return the next item.

        Raises:
            KeyError: there is none.
        """
        owner, items = self._of.popitem(last=False)
        item = items.popleft()
        self._length -= 1
        if items:
            self._of[owner] = items
        return item
