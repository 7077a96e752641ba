"""Fair queue: serves its owners in turn (round robin), however much one of them puts in.

Sans-I/O. Source: J. Nagle, On Packet Switches With Infinite Storage, RFC 970.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

_T = TypeVar("_T", bound=Hashable)


class FairQueue(Generic[_T]):
    """Items by owner: one of each owner in turn, each owner's oldest first. It has no bound of its own."""

    __slots__ = ("_of",)

    def __init__(self) -> None:
        self._of: OrderedDict[bytes, OrderedDict[_T, None]] = OrderedDict()

    def __len__(self) -> int:
        return sum(map(len, self._of.values()))

    def __bool__(self) -> bool:
        return bool(self._of)

    def put(self, owner: bytes, item: _T) -> None:
        """Put an item behind the others of its owner, unless it is there already."""
        self._of.setdefault(owner, OrderedDict())[item] = None

    def pop(self) -> _T:
        """Return the next item. Raises ``KeyError``: there is none."""
        owner, items = self._of.popitem(last=False)
        item, _ = items.popitem(last=False)
        if items:
            self._of[owner] = items
        return item

    def discard(self, owner: bytes, item: _T) -> None:
        """Remove an item; nothing happens if it is not there."""
        items = self._of.get(owner)
        if items is not None:
            items.pop(item, None)
            if not items:
                del self._of[owner]

    def clear(self) -> None:
        """Remove every item."""
        self._of.clear()
