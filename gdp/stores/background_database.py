"""SQLite file that is read at the start and then written in slices by one thread, so that a slow disk delays no frame.

I/O. The file is in WAL mode, and each slice is one transaction. A full disk or a broken file is reported once, and the
node continues without it. A slice that cannot be written is tried again. A file that is not a database is renamed to
``NAME.broken``.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Generic, TypeVar

from gdp.intervals import TICK_S

log = logging.getLogger(__name__)

_SLICES_WAITING_MAX: Final = 4

_S = TypeVar("_S")
_T = TypeVar("_T")


class BackgroundDatabase(ABC, Generic[_S]):
    """One file, and the thread that writes it.

    Args:
        what: word for the content in log lines, and the thread's name.
        level: of log lines about failures.
        schema: statement that creates the table if it is missing.
        synchronous: value of SQLite's pragma.

    Attributes:
        failures: attempts to read or write that failed.
    """

    def __init__(self, path: Path, what: str, level: int, schema: str, synchronous: str) -> None:
        self._path = path
        self._what = what
        self._level = level
        self._setup = (
            "PRAGMA locking_mode=EXCLUSIVE",  # before WAL; otherwise SQLite makes a file of shared memory
            "PRAGMA journal_mode=WAL",
            f"PRAGMA synchronous={synchronous}",
            schema,
        )
        self._slices: queue.Queue[_S | None] = queue.Queue(_SLICES_WAITING_MAX)
        self._is_closing = threading.Event()
        self._has_failed = False
        self.failures = 0
        self._thread = threading.Thread(target=self._work, name=what, daemon=True)

    def start(self) -> None:
        """Start the thread that writes the slices."""
        self._thread.start()

    @property
    def is_ready(self) -> bool:
        """Return whether ``write`` accepts another slice."""
        return not self._slices.full()

    def close(self) -> None:
        """Write the queued slices, each tried once, and end."""
        self._is_closing.set()
        if self._thread.is_alive():
            self._slices.put(None)
            self._thread.join()

    @abstractmethod
    def _write(self, database: sqlite3.Connection, slice_: _S, *, is_first: bool) -> None:
        """Write a slice within a transaction; ``is_first``: no slice was written through this connection before."""

    def _is_outdated(self, slice_: _S) -> bool:
        """Return whether a slice is dropped instead of written."""
        del slice_
        return False

    def _read_failed(self) -> None:
        """Note that the file may hold rows that this node does not know."""

    def _rows(self, read: Callable[[sqlite3.Connection], Iterator[_T]]) -> Iterator[_T]:
        """Yield what ``read`` finds; after an error, which is reported, the node starts without the rest."""
        try:
            with contextlib.closing(self._open()) as database:
                yield from read(database)
        except sqlite3.OperationalError as error:
            self.failures += 1
            self._read_failed()
            log.log(
                self._level, "%s not read path=%s reason=%s; the node starts without it", self._what, self._path, error
            )
        except sqlite3.DatabaseError as error:
            self._put_aside(error)

    def _open(self) -> sqlite3.Connection:
        """Return the locked database: SQLite then needs no other file to read the data of a killed node.

        Raises:
            sqlite3.Error: it cannot be opened, or is new and the disk is full.
        """
        database = sqlite3.connect(self._path, timeout=1.0)
        try:
            for statement in self._setup:
                database.execute(statement)
        except sqlite3.Error:
            database.close()
            raise
        return database

    def _work(self) -> None:
        database: sqlite3.Connection | None = None
        while (slice_ := self._slices.get()) is not None:
            while not self._is_outdated(slice_):
                try:
                    is_first, database = database is None, database or self._open()
                    with database:
                        self._write(database, slice_, is_first=is_first)
                except sqlite3.Error as error:
                    self._write_failed(error)
                    if self._is_closing.wait(TICK_S):
                        break
                else:
                    self._written(slice_)
                    break
        if database is not None:
            database.close()

    def _write_failed(self, error: sqlite3.Error) -> None:
        """Count each failure, and report the first of a series."""
        self.failures += 1
        if not self._has_failed:
            log.log(self._level, "%s not written path=%s reason=%s; trying again", self._what, self._path, error)
        self._has_failed = True

    def _written(self, slice_: _S) -> None:
        """Note that a slice is in the file."""
        del slice_
        if self._has_failed:
            log.info("%s written again path=%s", self._what, self._path)
        self._has_failed = False

    def _put_aside(self, error: sqlite3.DatabaseError) -> None:
        self.failures += 1
        aside = self._path.with_name(self._path.name + ".broken")
        path, level = self._path, self._level
        log.log(level, "%s cannot be read path=%s reason=%s; put aside as %s", self._what, path, error, aside)
        try:
            path.replace(aside)
        except OSError as failure:
            log.log(level, "%s cannot be put aside path=%s reason=%s", self._what, path, failure)
