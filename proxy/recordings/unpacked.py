"""Unpacking source: a recording whose messages were compressed one by one.

I/O, reading only.
"""

from __future__ import annotations

from collections.abc import Iterator

from proxy.recordings.source import Message, Source
from proxy.recordings.unpacking import SalvageError, unpack

__all__ = ["UnpackedSource"]


class UnpackedSource:
    """Messages unpacked as they are read; one that cannot be unpacked is omitted and reported."""

    def __init__(self, packed: Source) -> None:
        self.channels = packed.channels
        self._packed = packed
        self._refused = ""

    @property
    def count(self) -> int:
        """Return the number of messages, compressed or not."""
        return self._packed.count

    @property
    def unread(self) -> str:
        """Return why some could not be read or unpacked."""
        return "; ".join(text for text in (self._packed.unread, self._refused) if text)

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order."""
        for message in self._packed.messages():
            try:
                raw = unpack("zstd", message.raw)
            except SalvageError as error:
                self._refused = self._refused or f"a message could not be unpacked: {error}"
                continue
            yield message._replace(raw=raw)

    def close(self) -> None:
        """Close the files."""
        self._packed.close()
