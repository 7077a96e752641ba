"""History cache: the messages that a reliable writer can send again.

Sans-I/O. Source: HistoryCache of the RTPS specification (OMG DDSI-RTPS 2.5, section 8.2.2). Positions count bytes of
frames from the first message on.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

__all__ = ["CachedMessage", "HistoryCache"]


class CachedMessage(NamedTuple):
    """The frames of one message, and the position of its first byte."""

    frames: Sequence[bytes]
    begin_at: int
    size: int
    added_s: float = 0.0  # monotonic

    @property
    def end_at(self) -> int:
        """Return the position behind the last byte."""
        return self.begin_at + self.size

    def position(self, part: int) -> int:
        """Return the position at which a fragment begins; all fragments but the last have one length."""
        return self.begin_at + min(part * len(self.frames[0]), self.size)

    def sent_parts(self, sent_at: int) -> int:
        """Return how many fragments begin before the position ``sent_at``."""
        return max(-(-(sent_at - self.begin_at) // len(self.frames[0])), 0)


class HistoryCache:
    """Messages by number, oldest first.

    Args:
        depth: messages that stay for late joiners after every reader has acknowledged them.

    Attributes:
        depth_bytes: frames of so many bytes stay at most; None: the depth alone counts.
        age_s: a message stays for so many seconds at most; None: the depth alone counts.
        held_bytes: size of all frames.
        end_at: position behind the newest message.
    """

    def __init__(self, depth: int) -> None:
        self.depth = depth
        self.depth_bytes: int | None = None
        self.age_s: float | None = None
        self.held_bytes = 0
        self.end_at = 0
        self.messages: OrderedDict[int, CachedMessage] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self.messages)

    @property
    def oldest(self) -> int | None:
        """Return the lowest number, or None."""
        return next(iter(self.messages), None)

    def add(self, number: int, frames: Sequence[bytes], size: int, added_s: float = 0.0) -> None:
        """Add the newest message, of ``size`` bytes."""
        self.messages[number] = CachedMessage(frames, self.end_at, size, added_s)
        self.held_bytes += size
        self.end_at += size

    def remove(self, number: int) -> CachedMessage:
        """Remove and return a message. Raises ``KeyError``: it is not cached."""
        message = self.messages.pop(number)
        self.held_bytes -= message.size
        return message

    def beyond_depth(self, now_s: float = 0.0) -> list[int]:
        """Return the numbers that no late joiner needs, oldest first."""
        beyond = max(len(self.messages) - self.depth, 0)
        if self.depth_bytes is None and self.age_s is None:
            return list(islice(self.messages, beyond))
        numbers: list[int] = []
        held_bytes = self.held_bytes
        for number, message in self.messages.items():
            is_aged = self.age_s is not None and now_s - message.added_s >= self.age_s
            is_above = self.depth_bytes is not None and held_bytes > self.depth_bytes
            if len(numbers) >= beyond and not is_aged and not is_above:
                break
            numbers.append(number)
            held_bytes -= message.size
        return numbers

    def begin_of(self, number: int) -> int:
        """Return the position at which a message begins, or would begin if it were cached."""
        return next((each.begin_at for cached, each in self.messages.items() if cached >= number), self.end_at)
