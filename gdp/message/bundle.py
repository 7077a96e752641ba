"""Bundle: several small messages of one topic under one seal and one signature.

Sans-I/O. Source: docs/explanation/design.md, section 4: natural batching, never an added delay. Messages that wait
together when frames are requested are sent together.

Wire form, big-endian: for each message ``length (4) | message``; at least one message, nothing behind the last.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable
from typing import Final

from gdp.errors import DropReason, FrameError

# the largest bundle that a publisher makes; larger ones save hardly more, and the first message in it waits longer
BUNDLE_BYTES: Final = 48 << 10
# the largest bundle that a reader accepts: it bounds how many messages one frame may yield
BUNDLE_MAX_BYTES: Final = 64 << 10
_LENGTH: Final = struct.Struct("!I")
LENGTH_BYTES: Final = _LENGTH.size  # of a message in a bundle, in addition
SMALL: Final = 4  # a message is small if this number of its size fit into one bundle
_ALONE_BYTES: Final = 184  # overhead of a seal of its own: the waiting bytes must not weigh less than the sealed ones


def pack(messages: Iterable[bytes]) -> bytes:
    """Return the wire form."""
    return b"".join([each for message in messages for each in (_LENGTH.pack(len(message)), message)])


def unpack(wire: bytes) -> list[bytes]:
    """Read the wire form. Raises ``FrameError``: the bytes are not exactly one bundle; none of its messages counts."""
    if not 0 < len(wire) <= BUNDLE_MAX_BYTES:
        raise FrameError(DropReason.MALFORMED, "bundle")
    messages, at, end = [], 0, len(wire)
    while at < end:
        begin = at + _LENGTH.size
        if begin > end:
            raise FrameError(DropReason.TRUNCATED, "bundle")
        at = begin + _LENGTH.unpack_from(wire, at)[0]
        if at > end:
            raise FrameError(DropReason.TRUNCATED, "bundle")
        messages.append(wire[begin:at])
    return messages


class Gathered:
    """Small messages that wait for their seal, oldest first; their sequence numbers are consecutive.

    Attributes:
        messages: each with when it was published; None: unknown.
    """

    def __init__(self) -> None:
        self.messages = deque[tuple[bytes, float | None]]()
        self.first = 0  # sequence number of the oldest
        self.held_bytes = 0

    @property
    def oldest_bytes(self) -> int:
        """Return about how many bytes of frames the oldest message takes with a seal of its own."""
        return len(self.messages[0][0]) + _ALONE_BYTES

    def oldest_added_s(self, now_s: float) -> float:
        """Return when the oldest message was published; messages without a time wait from now on."""
        messages = self.messages
        at = len(messages)
        while at and messages[at - 1][1] is None:  # the newest ones
            at -= 1
            messages[at] = messages[at][0], now_s
        added_s = messages[0][1]
        return now_s if added_s is None else added_s

    def drop_oldest(self) -> int:
        """Remove the oldest message; return its sequence number."""
        self.held_bytes -= len(self.messages.popleft()[0]) + _ALONE_BYTES
        self.first += 1
        return self.first - 1

    def add(self, sequence: int, message: bytes, added_s: float | None = None) -> None:
        """Add a message that was published at ``added_s`` (monotonic seconds; None: unknown)."""
        if not self.messages:
            self.first = sequence
        self.messages.append((message, added_s))
        self.held_bytes += len(message) + _ALONE_BYTES

    def poll_batch(self, capacity: int) -> tuple[list[bytes], float | None]:
        """Remove and return the oldest message, and those after it that fit into ``capacity`` bytes of wire form.

        Returns:
            the messages, and when the newest of them was published.
        """
        messages, together, newest_s = self.messages, list[bytes](), None
        while messages:
            message, added_s = messages[0]
            size = len(message)
            capacity -= size + _LENGTH.size
            if together and capacity < 0:
                break
            messages.popleft()
            self.held_bytes -= size + _ALONE_BYTES
            self.first += 1
            newest_s = added_s
            together.append(message)
        return together, newest_s
