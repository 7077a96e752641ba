"""History cache: the messages that a writer can send again, and when their fragments left.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: HistoryCache of the RTPS specification (OMG DDSI-RTPS
2.5, section 8.2.2). Positions count bytes of frames from the first message on.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice


@dataclass(slots=True, kw_only=True)
class CachedMessage:
    """One message, and what of it has left.

    Attributes:
        frames: all of them, or of a best-effort message those that have left.
        begin_at: position of its first byte.
        size: bytes of its frames.
        added_s: when it was added.
        until_s: when its repair comes too late.
        batches: count of fragments sent, and when, after each batch of a best-effort message.
        again_s: when a fragment was last sent again.
    """

    frames: Sequence[bytes]
    begin_at: int = 0
    size: int = 0
    added_s: float = 0.0
    until_s: float = float("inf")
    batches: list[tuple[int, float]] = field(default_factory=list)
    again_s: dict[int, float] = field(default_factory=dict)

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
        repaired: how many of the messages were sent again, at least in part.
    """

    def __init__(self, depth: int = 0) -> None:
        self.depth = depth
        self.depth_bytes: int | None = None
        self.age_s: float | None = None
        self.held_bytes = 0
        self.end_at = 0
        self.repaired = 0
        self.messages: OrderedDict[int, CachedMessage] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self.messages)

    @property
    def oldest(self) -> int | None:
        """Return the lowest number, or None."""
        return next(iter(self.messages), None)

    def first_since(self, since_s: float) -> int | None:
        """Return the number of the first message that was added since a second, or None."""
        return next((number for number, each in self.messages.items() if each.added_s >= since_s), None)

    def add(self, number: int, frames: Sequence[bytes], size: int, added_s: float = 0.0) -> None:
        """Add the newest message, of ``size`` bytes."""
        self.messages[number] = CachedMessage(frames=frames, begin_at=self.end_at, size=size, added_s=added_s)
        self.held_bytes += size
        self.end_at += size

    def remove(self, number: int) -> CachedMessage:
        """Remove and return a message. Raises ``KeyError``: it is not cached."""
        message = self.messages.pop(number)
        self.held_bytes -= message.size
        if message.again_s:
            self.repaired -= 1
        return message

    def note_repair(self, number: int, part: int, now_s: float) -> bytes:
        """Note that a fragment is sent again now, and return it. Raises ``KeyError``: its message is not cached."""
        message = self.messages[number]
        self.repaired += not message.again_s
        message.again_s[part] = now_s
        return message.frames[part]

    def beyond_depth(self, now_s: float, below: int) -> list[int]:
        """Return the numbers under ``below`` that no late joiner needs, oldest first."""
        beyond = max(len(self.messages) - self.depth, 0)
        if self.depth_bytes is None and self.age_s is None:
            return [number for number in islice(self.messages, beyond) if number < below]
        held_bytes, numbers = self.held_bytes, list[int]()
        for number, message in self.messages.items():
            if number >= below:
                break
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
