"""Where the publishers of one life ended, so that whoever goes on with the same begins above.

Place: pure. A number that comes twice under one key is a nonce that comes twice. What is forgotten here, for there is
too much of it, raises the number at which everything unknown begins.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, NamedTuple

from gdp.names import Name

__all__ = ["FIRST", "SequenceRegistry", "SequenceState"]

SEQUENCE_REGISTRY_MAX: Final = 4_096


class SequenceState(NamedTuple):
    """The next number of a message, the last of a status, and the last sequence number of a message."""

    next_number: int = 1
    status_number: int = 0
    sequence: int = 0


FIRST: Final = SequenceState()


class SequenceRegistry:
    """The pasts of what is not published now, by topic."""

    def __init__(self, maximum: int = SEQUENCE_REGISTRY_MAX) -> None:
        self._of: OrderedDict[Name, SequenceState] = OrderedDict()
        self._floor = FIRST
        self._maximum = maximum

    def __len__(self) -> int:
        return len(self._of)

    def put(self, topic: Name, past: SequenceState) -> None:
        """Keep a past."""
        self._of[topic] = past
        self._of.move_to_end(topic)
        if len(self._of) > self._maximum:
            gone = self._of.popitem(last=False)[1]
            self._floor = SequenceState(*map(max, self._floor, gone))

    def of(self, topic: Name) -> SequenceState:
        """Return where whoever publishes a topic now is to go on."""
        return self._of.get(topic, self._floor)
