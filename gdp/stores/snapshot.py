"""Snapshot of a RIB's in-memory store on disk: read at the start, updated in the background.

I/O. Entries carry their proof: they are verified like data from a peer when they are read. A slice that cannot be
written is tried again, so that no withdrawal is missing from the file.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from gdp.control.rib_replication import Entry, Key
from gdp.errors import RemoteError
from gdp.stores.background_database import BackgroundDatabase

SLICE: Final = 512  # entries at once
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS entries (key BLOB PRIMARY KEY, entry BLOB NOT NULL, end_unix_s REAL NOT NULL) WITHOUT ROWID
"""

Change = tuple[Key, Entry | None]  # None: it was removed


class _Slice(NamedTuple):
    generation: int
    changes: Sequence[Change]
    unix_s: float  # when the changes were read


class Snapshot(BackgroundDatabase[_Slice]):
    """One snapshot file.

    Args:
        path: of the database.

    Attributes:
        unreadable: stored entries that could not be read.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "snapshot", logging.WARNING, _SCHEMA, "NORMAL")
        self.unreadable = 0
        self._generation = 0  # of the valid slices
        self._generation_in_file = 0  # entries of another generation are deleted before a write

    def load(self, unix_s: float) -> Iterator[list[Entry]]:
        """Yield the stored entries in slices, without leases that ended."""

        def read(database: sqlite3.Connection) -> Iterator[list[Entry]]:
            """Yield the valid entries."""
            rows = database.execute("SELECT entry, end_unix_s FROM entries WHERE end_unix_s > ?", (unix_s,))
            while slice_ := rows.fetchmany(SLICE):
                yield [entry for row in slice_ if (entry := self._read(row[0], row[1] - unix_s)) is not None]

        return self._rows(read)

    def write(self, changes: Sequence[Change], unix_s: float) -> None:
        """Queue changes to be written; the caller has checked ``is_ready``."""
        self._slices.put_nowait(_Slice(self._generation, changes, unix_s))

    def begin_again(self) -> None:
        """Drop slices that are not written yet; the next slice replaces the whole content of the file."""
        self._generation += 1

    def _read(self, wire: bytes, left_s: float) -> Entry | None:
        try:
            entry = Entry.from_cbor(wire)
        except RemoteError:
            self.unreadable += 1
            return None
        return replace(entry, lease_s=min(entry.lease_s, left_s))

    def _read_failed(self) -> None:
        self.begin_again()  # the file may hold entries that this RIB never receives

    def _is_outdated(self, slice_: _Slice) -> bool:
        return slice_.generation != self._generation

    def _write(self, database: sqlite3.Connection, slice_: _Slice, *, is_first: bool) -> None:
        if slice_.generation != self._generation_in_file:
            database.execute("DELETE FROM entries")
        elif is_first:
            database.execute("DELETE FROM entries WHERE end_unix_s <= ?", (slice_.unix_s,))
        gone = [(_key(key),) for key, entry in slice_.changes if entry is None]
        kept = [
            (
                _key(key),
                entry.to_cbor(),
                entry.until_unix_s or slice_.unix_s + entry.lease_s,
            )
            for key, entry in slice_.changes
            if entry is not None
        ]
        database.executemany("DELETE FROM entries WHERE key = ?", gone)
        database.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", kept)

    def _written(self, slice_: _Slice) -> None:
        self._generation_in_file = slice_.generation
        super()._written(slice_)


def _key(key: Key) -> bytes:
    name, advertiser = key
    return bytes(name) + bytes(advertiser)
