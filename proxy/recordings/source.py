"""Source of a recording's messages: the interface of all decoders, and its general forms.

Forms: positions found without an index, and several storage files.
I/O; files are opened for reading only.
"""

from __future__ import annotations

import heapq
import os
from abc import ABC, abstractmethod
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, Protocol

from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.unpacking import CHUNK_MAX_BYTES, SalvageError, unpack
from proxy.serial.channel import Channel

ZSTD: Final = b"\x28\xb5\x2f\xfd"
COMPRESSIONS: Final = {b"\x04\x22\x4d\x18": "lz4", b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ": "xz"}
_CHUNKS_KEPT: Final = 4  # unpacked at a time; messages close in time are close in the file


class Message(NamedTuple):
    """One recorded message."""

    channel: int  # index into the source's channels
    stamp_ns: int  # when it was recorded, Unix time
    raw: bytes
    origin: Origin | None = None  # what its publisher said of it, where that is recorded


class Source(Protocol):
    """An open recording."""

    channels: list[Channel]

    @property
    def count(self) -> int:
        """Return the number of readable messages, as far as known."""

    @property
    def counts(self) -> list[int] | None:
        """Return the messages of each channel, as far as known; None where they are not."""

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


class Heads(NamedTuple):
    """What lies before each message in the file: so many bytes, and the origin in them."""

    size: int
    origin: Callable[[bytes], Origin]


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

    def __init__(
        self, path: Path, channels: list[Channel], chunks: list[Chunk], places: list[Place], heads: Heads | None = None
    ) -> None:
        self.channels = channels
        self.unread = ""
        self._heads = heads
        self._chunks = chunks
        self._places = sorted(places)
        self._file: BinaryIO = path.open("rb")
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()

    @property
    def count(self) -> int:
        """Return the number of messages found."""
        return len(self._places)

    @property
    def counts(self) -> list[int] | None:
        """Return the messages found of each channel."""
        found = Counter(place.channel for place in self._places)
        return [found[index] for index in range(len(self.channels))]

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order."""
        for place in self._places:
            raw = self._read(place.chunk, place.at, place.size)
            yield Message(place.channel, place.stamp_ns, raw, self._origin(place))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _origin(self, place: Place) -> Origin | None:
        if self._heads is None:
            return None
        size = self._heads.size
        return self._heads.origin(self._read(place.chunk, place.at - size, size))

    def _read(self, number: int, at: int, size: int) -> bytes:
        """Return bytes of a chunk, or of the file itself."""
        if number < 0:
            self._file.seek(at)
            return self._file.read(size)
        if number not in self._unpacked:
            chunk = self._chunks[number]
            self._file.seek(chunk.at)
            self._unpacked[number] = unpack(chunk.compression, self._file.read(chunk.size), chunk.unpacked)
            while len(self._unpacked) > 1 and (
                len(self._unpacked) > _CHUNKS_KEPT or sum(map(len, self._unpacked.values())) > CHUNK_MAX_BYTES
            ):
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(number)
        return self._unpacked[number][at : at + size]


class Scan(ABC):
    """Contents of a file that is read from its beginning; a subclass knows the format and its words."""

    form: str
    empty = "no channel in it"
    heads: Heads | None = None

    def __init__(self) -> None:
        self.channels: list[Channel] = []
        self.chunks: list[Chunk] = []
        self.places: list[Place] = []
        self.stats = Tally()
        self.unclosed = ""  # why even a file that is read to its end lacks something
        self.left_out: list[str] = []  # topics that cannot be carried, each with the reason
        self._index: dict[int, int] = {}  # the format's number of a channel, to its index
        self._omitted: set[int] = set()  # the numbers of channels that are left out

    def add(self, number: int, topic: str, make: Callable[[], Channel]) -> None:
        """Add the channel that ``make`` returns; where that raises ``SalvageError``, the topic is left out."""
        try:
            channel = make()
        except SalvageError as error:
            self._omitted.add(number)
            self.left_out.append(f"topic {topic} is left out: {error}")
            return
        self._index[number] = len(self.channels)
        self.channels.append(channel)

    @abstractmethod
    def traverse(self, file: BinaryIO, size: int) -> str:
        """Read every record; return why it ended early, empty where it did not."""

    def source(self, path: Path, magic: bytes) -> ScannedSource:
        """Return the readable part of a file.

        Raises:
            SalvageError: nothing can be read.
            OSError: the file cannot be opened.
        """
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if file.read(len(magic)) != magic:
                raise SalvageError(f"not {self.form}")
            reason = self.traverse(file, size)
        if not self.channels:
            raise SalvageError(reason or "; ".join(self.left_out) or self.empty)
        source = ScannedSource(path, self.channels, self.chunks, self.places, self.heads)
        lacking = [self.stats.text(reason or self.unclosed)] if reason or self.unclosed else []
        source.unread = "; ".join([*lacking, *self.left_out])
        return source


class JoinedSource:
    """The parts of a split recording; equal channels become one. ``missing``: what is known to lack."""

    def __init__(self, parts: Sequence[Source], missing: Sequence[str] = ()) -> None:
        self.channels: list[Channel] = []
        self._parts = parts
        self._missing = missing
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
    def counts(self) -> list[int] | None:
        """Return the messages of each channel in all parts; None where a part does not know its own."""
        sums = [0] * len(self.channels)
        for part, indexes in zip(self._parts, self._indexes, strict=True):
            if part.counts is None:
                return None
            for index, count in zip(indexes, part.counts, strict=True):
                sums[index] += count
        return sums

    @property
    def unread(self) -> str:
        """Return what is missing, and the reports of the parts."""
        return "; ".join([*self._missing, *(part.unread for part in self._parts if part.unread)])

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
