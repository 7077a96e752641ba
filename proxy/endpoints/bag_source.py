"""What every way of reading a recording gives, and the places of messages found without an index.

Place: I/O; files are opened for reading only.
"""

from __future__ import annotations

import bz2
import sys
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, Protocol

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

from gdp.errors import LocalError
from proxy.serial.channel import Channel

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

__all__ = ["Chunk", "Message", "Place", "SalvageError", "ScannedSource", "Source", "Tally", "unpack"]

_CHUNKS_KEPT: Final = 4  # unpacked at a time; neighbours in time are neighbours in the file


class Message(NamedTuple):
    """One recorded message."""

    channel: int  # index into the source's channels
    stamp_ns: int  # when it was recorded, Unix time
    raw: bytes


class Source(Protocol):
    """An open recording."""

    channels: list[Channel]

    @property
    def count(self) -> int:
        """Messages that can be read, as far as known."""

    @property
    def unread(self) -> str:
        """Why some could not be read, empty where all could."""

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order; afterwards ``unread`` is final."""

    def close(self) -> None:
        """Close the files."""


class SalvageError(LocalError):
    """Not even the beginning of a file is a recording."""


class Chunk(NamedTuple):
    """A run of records, perhaps compressed."""

    at: int  # file offset of its data
    size: int  # bytes in the file, fewer than written where the file ends in it
    compression: str


class Place(NamedTuple):
    """Where a message lies; sorts by time, then by order in the file."""

    stamp_ns: int
    order: int
    channel: int
    chunk: int  # index, -1: in the file itself
    at: int
    size: int


def unpack(compression: str, data: bytes) -> bytes:
    """Return as much of a chunk as its bytes give; a chunk that ends early gives its beginning.

    Raises:
        SalvageError: the compression is unknown or the bytes are not of it.
    """
    try:
        match compression:
            case "" | "none":
                return data
            case "lz4":
                return bytes(LZ4FrameDecompressor().decompress(data))
            case "zstd":
                return bytes(zstd.ZstdDecompressor().decompress(data))
            case "bz2":
                return bz2.BZ2Decompressor().decompress(data)
            case _:
                raise SalvageError(f"compression {compression!r} is not supported")
    except (RuntimeError, OSError, ValueError, EOFError, zstd.ZstdError) as error:
        raise SalvageError(f"a chunk cannot be unpacked: {error}") from error


class Tally:
    """How much of a file was found, to say how much is probably gone."""

    def __init__(self) -> None:
        self.messages = 0
        self.walked_bytes = 0  # what held them
        self.missing_bytes = 0  # what should have followed, as far as the file says, measured alike

    def text(self, reason: str) -> str:
        """Return the reason with what was found and the estimate of what was not."""
        text = f"{reason}; {self.messages} messages were found"
        if self.missing_bytes and self.messages:
            lost = max(1, round(self.missing_bytes * self.messages / max(1, self.walked_bytes)))
            text += f", up to about {lost} more are lost"
        return text


class ScannedSource:
    """Messages found by walking a file from its beginning; read back in time order."""

    def __init__(self, path: Path, channels: list[Channel], chunks: list[Chunk], places: list[Place]) -> None:
        self.channels = channels
        self.unread = ""
        self._chunks = chunks
        self._places = sorted(places)
        self._file: BinaryIO = path.open("rb")
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()

    @property
    def count(self) -> int:
        """Messages found."""
        return len(self._places)

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order."""
        for place in self._places:
            yield Message(place.channel, place.stamp_ns, self._raw(place))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _raw(self, place: Place) -> bytes:
        if place.chunk < 0:
            self._file.seek(place.at)
            return self._file.read(place.size)
        if place.chunk not in self._unpacked:
            chunk = self._chunks[place.chunk]
            self._file.seek(chunk.at)
            self._unpacked[place.chunk] = unpack(chunk.compression, self._file.read(chunk.size))
            if len(self._unpacked) > _CHUNKS_KEPT:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(place.chunk)
        return self._unpacked[place.chunk][place.at : place.at + place.size]
