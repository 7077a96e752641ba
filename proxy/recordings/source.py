"""Source of a recording's messages: the interface of all decoders, and the positions found without an index.

I/O; files are opened for reading only.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, Protocol

from proxy.recordings.unpacking import CHUNK_MAX_BYTES, unpack
from proxy.serial.channel import Channel

__all__ = ["Chunk", "Message", "Place", "ScannedSource", "Source", "Tally"]

_CHUNKS_KEPT: Final = 4  # unpacked at a time; messages close in time are close in the file


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
        """Return the number of readable messages, as far as known."""

    @property
    def unread(self) -> str:
        """Return why some could not be read, empty where all could."""

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order; afterwards ``unread`` is final."""

    def close(self) -> None:
        """Close the files."""


class Chunk(NamedTuple):
    """A run of records, possibly compressed."""

    at: int  # file offset of its data
    size: int  # bytes in the file, fewer than written where the file is truncated
    compression: str
    unpacked: int | None  # bytes, as its header states


class Place(NamedTuple):
    """Position of a message; sorts by time, then by order in the file."""

    stamp_ns: int
    order: int
    channel: int
    chunk: int  # index, -1: in the file itself
    at: int
    size: int


class Tally:
    """Amount of a file that was found, to estimate the amount that is missing."""

    def __init__(self) -> None:
        self.messages = 0
        self.scanned_bytes = 0  # bytes that held them
        self.missing_bytes = 0  # bytes that should have followed, as far as the file states, in the same measure

    def text(self, reason: str) -> str:
        """Return the reason with the number found and the estimate of the missing ones."""
        text = f"{reason}; {self.messages} messages were found"
        if self.missing_bytes and self.messages:
            lost = max(1, round(self.missing_bytes * self.messages / max(1, self.scanned_bytes)))
            text += f", up to about {lost} more are lost"
        return text


class ScannedSource:
    """Messages found by scanning a file from its beginning; yielded in time order."""

    def __init__(self, path: Path, channels: list[Channel], chunks: list[Chunk], places: list[Place]) -> None:
        self.channels = channels
        self.unread = ""
        self._chunks = chunks
        self._places = sorted(places)
        self._file: BinaryIO = path.open("rb")
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()

    @property
    def count(self) -> int:
        """Return the number of messages found."""
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
            self._unpacked[place.chunk] = unpack(chunk.compression, self._file.read(chunk.size), chunk.unpacked)
            while len(self._unpacked) > 1 and (
                len(self._unpacked) > _CHUNKS_KEPT or sum(map(len, self._unpacked.values())) > CHUNK_MAX_BYTES
            ):
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(place.chunk)
        return self._unpacked[place.chunk][place.at : place.at + place.size]
