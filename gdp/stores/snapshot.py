"""Snapshot of a RIB's in-memory store on disk: read at the start, updated in the background.

I/O. SQLite in WAL mode, written by one thread in slices, each of which is one transaction. A full disk or a broken file
is reported once, and the RIB continues without it. A slice that cannot be written is tried again, so that no withdrawal
is missing from the file. Entries carry their proof: they are verified like data from a peer when they are read.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from gdp.control.replica import Entry, Key
from gdp.crypto import cbor, cbor_writer
from gdp.crypto.fields import Fields
from gdp.errors import RemoteError

__all__ = ["SLICE", "Snapshot"]

log = logging.getLogger(__name__)

SLICE: Final = 512  # entries at once
RETRY_S: Final = 0.5  # between two attempts to write a slice
_SLICES_WAITING_MAX: Final = 4
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS entries (key BLOB PRIMARY KEY, entry BLOB NOT NULL, end_unix_s REAL NOT NULL) WITHOUT ROWID
"""

Change = tuple[Key, Entry | None]  # None: it was removed


class _Slice(NamedTuple):
    generation: int
    changes: Sequence[Change]
    unix_s: float  # when the changes were read


class Snapshot:
    """One snapshot file.

    Args:
        path: of the database; a file that is not a database is renamed to ``PATH.broken``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._slices: queue.Queue[_Slice | None] = queue.Queue(_SLICES_WAITING_MAX)
        self.failures = 0
        self.unreadable = 0
        self._has_failed = False
        self._generation = 0  # of the valid slices
        self._generation_in_file = 0  # entries of another generation are deleted before a write
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="snapshot", daemon=True)

    def load(self, unix_s: float) -> Iterator[list[Entry]]:
        """Yield the stored entries in slices, without leases that ended."""
        try:
            with contextlib.closing(_opened(self._path)) as database:
                rows = database.execute("SELECT entry, end_unix_s FROM entries WHERE end_unix_s > ?", (unix_s,))
                while slice_ := rows.fetchmany(SLICE):
                    yield [entry for row in slice_ if (entry := self._read(row[0], row[1] - unix_s)) is not None]
        except sqlite3.OperationalError as error:
            self.failures += 1
            self.begin_again()  # the file may hold entries that this RIB never receives
            log.warning("snapshot not read path=%s reason=%s; the RIB starts without it", self._path, error)
        except sqlite3.DatabaseError as error:
            self._put_aside(error)

    def start(self) -> None:
        """Start the thread that writes the changes of ``write``."""
        self._thread.start()

    @property
    def is_ready(self) -> bool:
        """Return whether ``write`` accepts another slice."""
        return not self._slices.full()

    def write(self, changes: Sequence[Change], unix_s: float) -> None:
        """Queue changes to be written; the caller has checked ``is_ready``."""
        self._slices.put_nowait(_Slice(self._generation, changes, unix_s))

    def begin_again(self) -> None:
        """Drop slices that are not written yet; the next slice replaces the whole content of the file."""
        self._generation += 1

    def close(self) -> None:
        """Write the queued slices, each tried once, and end."""
        self._is_closing.set()
        if self._thread.is_alive():
            self._slices.put(None)
            self._thread.join()

    def _read(self, wire: bytes, left_s: float) -> Entry | None:
        try:
            decoded = cbor.decode(wire)
            entry = Entry.from_fields(Fields(decoded if isinstance(decoded, dict) else {}))
        except RemoteError:
            self.unreadable += 1
            return None
        return replace(entry, lease_s=min(entry.lease_s, left_s))

    def _work(self) -> None:
        database: sqlite3.Connection | None = None
        while (item := self._slices.get()) is not None:
            while item.generation == self._generation:
                try:
                    is_first, database = database is None, database or _opened(self._path)
                    with database:
                        if item.generation != self._generation_in_file:
                            database.execute("DELETE FROM entries")
                        elif is_first:
                            database.execute("DELETE FROM entries WHERE end_unix_s <= ?", (item.unix_s,))
                        _write(database, item.changes, item.unix_s)
                except sqlite3.Error as error:
                    self._write_failed(error)
                    if self._is_closing.wait(RETRY_S):
                        break
                else:
                    self._generation_in_file = item.generation
                    self._written()
                    break
        if database is not None:
            database.close()

    def _write_failed(self, error: sqlite3.Error) -> None:
        """Count each failure, and report the first of a series."""
        self.failures += 1
        if not self._has_failed:
            log.warning("snapshot not written path=%s reason=%s; the RIB goes on without it", self._path, error)
        self._has_failed = True

    def _written(self) -> None:
        if self._has_failed:
            log.info("snapshot written again path=%s", self._path)
        self._has_failed = False

    def _put_aside(self, error: sqlite3.DatabaseError) -> None:
        self.failures += 1
        aside = self._path.with_name(self._path.name + ".broken")
        log.warning("snapshot cannot be read path=%s reason=%s; put aside as %s", self._path, error, aside)
        try:
            self._path.replace(aside)
        except OSError as failure:
            log.warning("snapshot cannot be put aside path=%s reason=%s", self._path, failure)


def _opened(path: Path) -> sqlite3.Connection:
    """Return the locked database: SQLite then needs no other file to read the data of a killed RIB.

    Raises:
        sqlite3.Error: it cannot be opened, or is new and the disk is full.
    """
    database = sqlite3.connect(path, timeout=1.0)
    try:
        database.execute("PRAGMA locking_mode=EXCLUSIVE")  # before WAL; otherwise SQLite makes a file of shared memory
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA synchronous=NORMAL")
        database.execute(_SCHEMA)
    except sqlite3.Error:
        database.close()
        raise
    return database


def _write(database: sqlite3.Connection, changes: Sequence[Change], unix_s: float) -> None:
    gone = [(_key(key),) for key, entry in changes if entry is None]
    kept = [
        (
            _key(key),
            cbor_writer.encode(entry.to_fields()),
            entry.until_unix_s or unix_s + entry.lease_s,
        )
        for key, entry in changes
        if entry is not None
    ]
    database.executemany("DELETE FROM entries WHERE key = ?", gone)
    database.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", kept)


def _key(key: Key) -> bytes:
    name, advertiser = key
    return bytes(name) + bytes(advertiser)
