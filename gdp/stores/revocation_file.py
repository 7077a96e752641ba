"""Revocation file: a node's revocations on disk, so that it still rejects every revoked key after a restart.

I/O. One SQLite file in WAL mode, synced with every slice, written by one thread, so that a slow disk delays no frame. A
killed process or machine leaves the synced data. The file is private to this user; each statement in it is still
verified when it is read. A file that is not a database is renamed to ``revocations.broken``. A full disk is reported
once, and the next slice tries again.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from gdp.errors import LocalError
from gdp.limits import CLOCK_SKEW_S
from gdp.stores.ownership import refuse_shared_folder
from gdp.trust.revocations import Kept, KeptKey

__all__ = ["SLICE", "RevocationFile", "Row"]

log = logging.getLogger(__name__)

SLICE: Final = 1_024  # rows at once
_NAME: Final = "revocations"
_RETRY_S: Final = 0.5
_SLICES_WAITING_MAX: Final = 4
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS revocations (
    key BLOB PRIMARY KEY, is_root INTEGER NOT NULL, giver BLOB NOT NULL, until INTEGER NOT NULL, statement BLOB NOT NULL
) WITHOUT ROWID
"""

Change = tuple[KeptKey, Kept | None]  # None: it was removed


class Row(NamedTuple):
    """One revocation as it was written."""

    is_root: bool
    origin: bytes
    statement: bytes


class RevocationFile:
    """The revocation file of one node.

    Args:
        folder: the node's state folder.

    Raises:
        LocalError: others may write to the folder, or it is another user's.
    """

    def __init__(self, folder: Path) -> None:
        try:
            refuse_shared_folder(folder)
        except OSError as error:
            raise LocalError(f"{folder}: {error.strerror}") from error
        self._path = folder / _NAME
        self._slices: queue.Queue[Sequence[Change] | None] = queue.Queue(_SLICES_WAITING_MAX)
        self._is_closing = threading.Event()
        self._has_failed = False
        self.failures = 0
        self._thread = threading.Thread(target=self._work, name="revocations", daemon=True)

    def load(self, unix_s: float) -> Iterator[Row]:
        """Yield the stored revocations that have not expired, those of roots first."""
        try:
            with contextlib.closing(_opened(self._path)) as database:
                with database:
                    database.execute("DELETE FROM revocations WHERE until < ?", (int(unix_s - CLOCK_SKEW_S),))
                rows = database.execute("SELECT is_root, giver, statement FROM revocations ORDER BY is_root DESC")
                for is_root, origin, statement in rows:
                    yield Row(bool(is_root), bytes(origin), bytes(statement))
        except sqlite3.OperationalError as error:
            self.failures += 1
            log.error("revocations not read path=%s reason=%s; the node starts without them", self._path, error)
        except sqlite3.DatabaseError as error:
            self._put_aside(error)

    def start(self) -> None:
        """Start the thread that writes the changes of ``write``."""
        self._thread.start()

    @property
    def is_ready(self) -> bool:
        """Return whether ``write`` accepts another slice."""
        return not self._slices.full()

    def write(self, changes: Sequence[Change]) -> None:
        """Queue changes to be written; the caller has checked ``is_ready``."""
        self._slices.put_nowait(changes)

    def close(self) -> None:
        """Write the queued slices, each tried once, and end."""
        self._is_closing.set()
        if self._thread.is_alive():
            self._slices.put(None)
            self._thread.join()

    def _work(self) -> None:
        database: sqlite3.Connection | None = None
        while (changes := self._slices.get()) is not None:
            while True:
                try:
                    database = database or _opened(self._path)
                    with database:
                        _write(database, changes)
                except sqlite3.Error as error:
                    self._failed(error)
                    if self._is_closing.wait(_RETRY_S):
                        break
                else:
                    self._written()
                    break
        if database is not None:
            database.close()

    def _failed(self, error: sqlite3.Error) -> None:
        self.failures += 1
        if not self._has_failed:
            log.error("revocations not written path=%s reason=%s; trying again", self._path, error)
        self._has_failed = True

    def _written(self) -> None:
        if self._has_failed:
            log.info("revocations written again path=%s", self._path)
        self._has_failed = False

    def _put_aside(self, error: sqlite3.DatabaseError) -> None:
        self.failures += 1
        aside = self._path.with_name(_NAME + ".broken")
        log.error("revocations cannot be read path=%s reason=%s; put aside as %s", self._path, error, aside)
        try:
            self._path.replace(aside)
        except OSError as failure:
            log.error("revocations cannot be put aside path=%s reason=%s", self._path, failure)


def _opened(path: Path) -> sqlite3.Connection:
    """Return the database, private to this user.

    Raises:
        sqlite3.Error: it cannot be opened.
    """
    before = os.umask(0o077)
    try:
        database = sqlite3.connect(path, timeout=1.0)
        try:
            # before WAL; otherwise SQLite makes a file of shared memory
            database.execute("PRAGMA locking_mode=EXCLUSIVE")
            database.execute("PRAGMA journal_mode=WAL")
            database.execute("PRAGMA synchronous=FULL")
            database.execute(_SCHEMA)
        except sqlite3.Error:
            database.close()
            raise
        return database
    finally:
        os.umask(before)


def _write(database: sqlite3.Connection, changes: Sequence[Change]) -> None:
    gone = [(b"".join(key),) for key, kept in changes if kept is None]
    added = [
        (b"".join(key), int(kept.is_root), kept.origin, kept.until_unix_s, kept.wire)
        for key, kept in changes
        if kept is not None
    ]
    database.executemany("DELETE FROM revocations WHERE key = ?", gone)
    database.executemany("INSERT OR REPLACE INTO revocations VALUES (?, ?, ?, ?, ?)", added)
