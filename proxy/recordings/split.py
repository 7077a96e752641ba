"""Split recording: several storage files as one recording, in time order.

I/O, reading only.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence

from proxy.recordings.source import Message, Source
from proxy.serial.channel import Channel

__all__ = ["JoinedSource"]


class JoinedSource:
    """The parts of a split recording; equal channels become one."""

    def __init__(self, parts: Sequence[Source]) -> None:
        self.channels: list[Channel] = []
        self._parts = parts
        self._indexes: list[list[int]] = []
        known: dict[Channel, int] = {}
        for part in parts:
            indexes = []
            for channel in part.channels:
                if channel not in known:
                    known[channel] = len(self.channels)
                    self.channels.append(channel)
                indexes.append(known[channel])
            self._indexes.append(indexes)

    @property
    def count(self) -> int:
        """Return the messages of all parts."""
        return sum(part.count for part in self._parts)

    @property
    def unread(self) -> str:
        """Return the reports of the parts."""
        return "; ".join(part.unread for part in self._parts if part.unread)

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order."""
        streams = [
            _renumbered(part.messages(), indexes) for part, indexes in zip(self._parts, self._indexes, strict=True)
        ]
        return heapq.merge(*streams, key=lambda message: message.stamp_ns)

    def close(self) -> None:
        """Close the parts."""
        for part in self._parts:
            part.close()


def _renumbered(messages: Iterator[Message], indexes: list[int]) -> Iterator[Message]:
    for message in messages:
        yield message._replace(channel=indexes[message.channel])
