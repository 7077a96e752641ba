"""Stream of frames from the process that decodes a recording to the process that uses it.

Sans-I/O. A frame is a kind (1 byte), a length (4 bytes, little-endian) and so many bytes. The using process trusts no
input: it checks each length and number.

```
 CHANNEL   one description, as peers send it           one for each channel, before OPENED
 OPENED    messages (8), has_counts (1), counts (8 each)
 BLOCK     {channel (4), stamp in ns (8), size (4), publish time in ns (8), number (4), bytes} ...
           above 128 KiB: exactly one message; a time and number of 0: none are recorded
 END       why some messages could not be read, UTF-8
 REFUSED   why it is no recording, UTF-8               the last frame
 FAILED    the decoder's error, UTF-8; empty: out of memory   the last frame
```
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterator, Sequence
from enum import IntEnum
from typing import Final, TypeAlias

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.source import Message
from proxy.serial.channel import CHANNEL_MAX_BYTES, Channel

BLOCK_BYTES: Final = 128 << 10  # small messages are collected up to this size
CHANNELS_MAX: Final = 16_384
CHANNELS_MAX_BYTES: Final = 32 << 20  # of all descriptions
# eight times the largest that can be sent; more exceeds the memory of a small robot
MESSAGE_MAX_BYTES: Final = 256 << 20
_TEXT_MAX: Final = 4_096

_HEAD: Final = struct.Struct("<BI")
_MESSAGE: Final = struct.Struct("<IqIQI")
_NO_ORIGIN: Final = Origin(0, 0)
_OPENED: Final = struct.Struct("<Q?")
_COUNT: Final = struct.Struct("<Q")


class Kind(IntEnum):
    """Content of a frame."""

    CHANNEL = 1
    OPENED = 2
    BLOCK = 3
    END = 4
    REFUSED = 5
    FAILED = 6


_LONGEST: Final = {
    Kind.CHANNEL: CHANNEL_MAX_BYTES,
    Kind.OPENED: _OPENED.size + CHANNELS_MAX * _COUNT.size,
    Kind.BLOCK: BLOCK_BYTES + _MESSAGE.size + MESSAGE_MAX_BYTES,
    Kind.END: _TEXT_MAX,
    Kind.REFUSED: _TEXT_MAX,
    Kind.FAILED: _TEXT_MAX,
}


Take: TypeAlias = Callable[[int], bytes]  # returns this many of the next bytes


class RefusedError(LocalError):
    """The decoder reports why the file is no recording."""


class FailedError(LocalError):
    """The decoder reports why it failed; empty: out of memory."""


def frame_head(kind: Kind, size: int) -> bytes:
    """Return the head of a frame with ``size`` bytes."""
    return _HEAD.pack(kind, size)


def message_head(message: Message) -> bytes:
    """Return the header of a message.

    Raises:
        LocalError: the message is too large, or its stamp has more than 64 bits.
    """
    size = len(message.raw)
    if size > MESSAGE_MAX_BYTES:
        raise LocalError(f"a message of {size} bytes; at most {MESSAGE_MAX_BYTES} are read")
    try:
        return _MESSAGE.pack(message.channel, message.stamp_ns, size, *(message.origin or _NO_ORIGIN))
    except struct.error as error:
        raise LocalError(f"a message with the stamp {message.stamp_ns}") from error


def opened_to(count: int, counts: Sequence[int] | None) -> bytes:
    """Return the bytes of OPENED. Raises ``LocalError``: there are too many channels, or numbers above 64 bits."""
    if counts is not None and len(counts) > CHANNELS_MAX:
        raise LocalError(f"{len(counts)} topics; at most {CHANNELS_MAX} are read")
    try:
        return _OPENED.pack(count, counts is not None) + b"".join(map(_COUNT.pack, counts or ()))
    except struct.error as error:
        raise LocalError("a number of messages that cannot be") from error


def text_to(text: str) -> bytes:
    """Return a text's bytes, cut where it is too long."""
    return text.encode("utf-8", "replace")[:_TEXT_MAX]


class FrameReader:
    """Parser of a decoder's frames, which enforces their order.

    Attributes:
        channels: of the recording; empty before ``open``.
        is_giving: whether messages follow, up to END.
        given: messages so far.
    """

    def __init__(self) -> None:
        self.channels: list[Channel] = []
        self.is_giving = False
        self.given = 0

    def open(self, take: Take) -> tuple[int, list[int] | None]:
        """Read the channels; return the number of messages, and that of each channel where it is known.

        Raises:
            RefusedError, FailedError: the decoder reports why it ends.
            LocalError, RemoteError: an unexpected frame.
        """
        left = CHANNELS_MAX_BYTES
        while True:
            kind, size = self._head(take)
            left -= size
            if kind == Kind.OPENED:
                return self._counts(take(size))
            if kind != Kind.CHANNEL or left < 0 or len(self.channels) == CHANNELS_MAX:
                raise LocalError(f"{kind.name} before OPENED")
            self.channels.append(Channel.from_cbor(take(size)))

    def skip(self, take: Take) -> None:
        """Discard the remaining messages."""
        while self.is_giving:
            kind, size = self._head(take)
            take(size)
            self.is_giving = kind == Kind.BLOCK

    def messages(self, take: Take) -> Generator[Message, None, str]:
        """Yield messages up to END; return why some could not be read.

        Raises:
            RefusedError, FailedError: the decoder reports why it ends.
            LocalError: an unexpected frame.
        """
        self.is_giving, self.given = True, 0
        while True:
            kind, size = self._head(take)
            if kind == Kind.END:
                self.is_giving = False
                return _text(take(size))
            if kind != Kind.BLOCK:
                raise LocalError(f"{kind.name} among messages")
            found = [self._large(take, size - _MESSAGE.size)] if size > BLOCK_BYTES else self._small(take(size))
            for message in found:
                self.given += 1
                yield message

    def _head(self, take: Take) -> tuple[Kind, int]:
        number, size = _HEAD.unpack(take(_HEAD.size))
        try:
            kind = Kind(number)
        except ValueError as error:
            raise LocalError(f"a frame of kind {number}") from error
        if size > _LONGEST[kind]:
            raise LocalError(f"a frame of {size} bytes")
        if kind == Kind.REFUSED:
            raise RefusedError(_text(take(size)))
        if kind == Kind.FAILED:
            raise FailedError(_text(take(size)))
        return kind, size

    def _counts(self, data: bytes) -> tuple[int, list[int] | None]:
        if len(data) < _OPENED.size:
            raise LocalError("the numbers of messages are cut off")
        count, has_counts = _OPENED.unpack_from(data)
        rest = data[_OPENED.size :]
        if len(rest) != (len(self.channels) * _COUNT.size if has_counts else 0):
            raise LocalError("numbers of messages of other channels")
        return count, [number for (number,) in _COUNT.iter_unpack(rest)] if has_counts else None

    def _large(self, take: Take, size: int) -> Message:
        channel, stamp_ns, said, *origin = _MESSAGE.unpack(take(_MESSAGE.size))
        if channel >= len(self.channels) or said != size:
            raise LocalError("a block that does not hold together")
        return Message(channel, stamp_ns, take(size), Origin(*origin) if any(origin) else None)

    def _small(self, block: bytes) -> Iterator[Message]:
        at = 0
        while at < len(block):
            if at + _MESSAGE.size > len(block):
                raise LocalError("a block that ends in a head")
            channel, stamp_ns, size, *origin = _MESSAGE.unpack_from(block, at)
            at += _MESSAGE.size
            if channel >= len(self.channels) or at + size > len(block):
                raise LocalError("a block that does not hold together")
            yield Message(channel, stamp_ns, block[at : at + size], Origin(*origin) if any(origin) else None)
            at += size


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")
