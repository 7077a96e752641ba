"""Revocation file: a node's revocations on disk, so that it still rejects every revoked key after a restart.

I/O. The file is synced with every slice, and private to this user; each statement in it is still verified when it is
read.
"""

from __future__ import annotations

import logging
import os
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from gdp.errors import LocalError
from gdp.limits import CLOCK_SKEW_S
from gdp.stores.background_database import BackgroundDatabase
from gdp.stores.ownership import refuse_shared_folder
from gdp.trust.revocations import Kept, KeptKey

SLICE: Final = 1_024  # rows at once
_NAME: Final = "revocations"
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


class RevocationFile(BackgroundDatabase[Sequence[Change]]):
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
        super().__init__(folder / _NAME, _NAME, logging.ERROR, _SCHEMA, "FULL")

    def load(self, unix_s: float) -> Iterator[Row]:
        """Yield the stored revocations that have not expired, those of roots first."""

        def read(database: sqlite3.Connection) -> Iterator[Row]:
            """Delete the expired rows, and yield the others."""
            with database:
                database.execute("DELETE FROM revocations WHERE until < ?", (int(unix_s - CLOCK_SKEW_S),))
            rows = database.execute("SELECT is_root, giver, statement FROM revocations ORDER BY is_root DESC")
            for is_root, origin, statement in rows:
                yield Row(bool(is_root), bytes(origin), bytes(statement))

        return self._rows(read)

    def write(self, changes: Sequence[Change]) -> None:
        """Queue changes to be written; the caller has checked ``is_ready``."""
        self._slices.put_nowait(changes)

    def _open(self) -> sqlite3.Connection:
        try:  # SQLite gives the files next to it the same mode; a umask would be that of other threads, too
            os.close(os.open(self._path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600))
        except OSError as error:
            raise sqlite3.OperationalError(error.strerror) from error
        return super()._open()

    def _write(self, database: sqlite3.Connection, slice_: Sequence[Change], *, is_first: bool) -> None:
        del is_first
        gone = [(b"".join(key),) for key, kept in slice_ if kept is None]
        added = [
            (b"".join(key), int(kept.is_root), kept.origin, kept.until_unix_s, kept.wire)
            for key, kept in slice_
            if kept is not None
        ]
        database.executemany("DELETE FROM revocations WHERE key = ?", gone)
        database.executemany("INSERT OR REPLACE INTO revocations VALUES (?, ?, ?, ?, ?)", added)
