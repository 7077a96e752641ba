"""Last used sequence numbers of ended publishers, so that a later publisher of the same topic begins above them.

Sans-I/O. A number that is used twice under one key is a nonce that is used twice. The registry is bounded. An evicted
entry raises the number at which every unknown topic begins.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, NamedTuple

from gdp.names import Name

SEQUENCE_REGISTRY_MAX: Final = 4_096


class SequenceState(NamedTuple):
    """The next number of a message, the last of a Heartbeat, and the last sequence number of a message."""

    next_number: int = 1
    status_number: int = 0
    sequence: int = 0


FIRST: Final = SequenceState()


class SequenceRegistry:
    """Last numbers of topics that are not published now."""

    def __init__(self, maximum: int = SEQUENCE_REGISTRY_MAX) -> None:
        self._of: OrderedDict[Name, SequenceState] = OrderedDict()
        self._minimum = FIRST
        self._maximum = maximum

    def __len__(self) -> int:
        return len(self._of)

    def put(self, topic: Name, past: SequenceState) -> None:
        """Store the last numbers of a topic."""
        self._of[topic] = past
        self._of.move_to_end(topic)
        if len(self._of) > self._maximum:
            gone = self._of.popitem(last=False)[1]
            self._minimum = SequenceState(*map(max, self._minimum, gone))

    def of(self, topic: Name) -> SequenceState:
        """Return the numbers above which a publisher of a topic begins now."""
        return self._of.get(topic, self._minimum)
