"""Records of a member: fixed size, appended to a file, and their reader.

I/O. One file. Written records remain when the writer is killed, because the kernel holds them from then on.
"""

from __future__ import annotations

import os
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


class RecordWriter:
    """Writer of records; ``flush`` passes them to the kernel."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        self._waiting: list[bytes] = []

    def add(self, kind: Kind, channel: int, incarnation_id: int, other: int, number: int, at_ns: int) -> None:
        """Add one record."""
        self._waiting.append(_FORM.pack(kind, channel, incarnation_id, other, number, at_ns))

    def flush(self) -> None:
        """Write the pending records."""
        if self._waiting:
            os.write(self._file, b"".join(self._waiting))
            self._waiting.clear()


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
