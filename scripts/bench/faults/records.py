"""Records of a member: fixed size, appended to a file, and their reader.

I/O. One file. Flushed records remain when the writer is killed, because the kernel holds them from then on.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

_FORM: Final = struct.Struct("=BBHIQQ")


class Kind(IntEnum):
    """Kind of a record, and the meaning of its ``other`` and ``number``."""

    PUBLISHED = 1  # number: of the message
    DELIVERED = 2  # other: the publisher; life: its incarnation
    LOST = 3  # number: how many more messages were reported lost to the reader; other: the reason, a ``LossReason``
    WRONG = 4  # other: the channel that the message was meant for
    CALLED = 5  # number: of the request
    ANSWERED = 6
    FAILED = 7


class Record(NamedTuple):
    """One record; ``channel``: the index of a flow or service; ``at_ns``: monotonic."""

    kind: int
    channel: int
    incarnation_id: int
    other: int
    number: int
    at_ns: int

    def to_bytes(self) -> bytes:
        """Return the record as ``RecordReader`` reads it."""
        return _FORM.pack(*self)


class RecordReader:
    """Reader of a file that still grows."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0

    def read(self) -> Iterator[Record]:
        """Yield the records since the last call."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._at)
            data = file.read()
        whole = len(data) - len(data) % _FORM.size
        self._at += whole
        for fields in _FORM.iter_unpack(data[:whole]):
            yield Record(*fields)
