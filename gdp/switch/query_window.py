"""Query window: how many queries for new names a switch has in flight at its RIB.

Sans-I/O. The window makes a switch query at the pace at which the RIB responds. Without it, repeated queries lengthen
the queue at the RIB, and no response comes in time. Names that wait for the window are served round robin by owner.
"""

from __future__ import annotations

from typing import Final

from gdp.message.fair_queue import FairQueue
from gdp.names import Name

__all__ = ["WINDOW", "QueryWindow"]

WINDOW: Final = 128  # a tenth of a second's work of a RIB


class QueryWindow:
    """Names in flight, at most ``size``, and the names that wait for a free slot.

    Args:
        size: most names in flight.
    """

    __slots__ = ("_in_flight", "_size", "_waiting")

    def __init__(self, size: int = WINDOW) -> None:
        self._size = size
        self._waiting = FairQueue[Name]()
        self._in_flight: set[Name] = set()

    @property
    def is_ready(self) -> bool:
        """Return whether a name waits and the window has space for it."""
        return bool(self._waiting) and len(self._in_flight) < self._size

    def put(self, owner: bytes, name: Name) -> None:
        """Add a name to the names of its owner that wait; a name that waits already keeps its position."""
        self._waiting.put(owner, name)

    def pop(self) -> Name:
        """Remove the next name that waits and return it; the caller sends its query, or drops it.

        Raises:
            KeyError: no name waits.
        """
        return self._waiting.pop()

    def sent(self, name: Name) -> None:
        """Record that the query for a name is in flight."""
        self._in_flight.add(name)

    def answered(self, name: Name) -> None:
        """Record that a name is not in flight any more."""
        self._in_flight.discard(name)

    def cancel(self, owner: bytes, name: Name) -> None:
        """Remove a name that waits; a name in flight stays in flight."""
        self._waiting.discard(owner, name)
