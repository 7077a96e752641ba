"""SQLite file that threads and processes share: each use is one transaction, each error names the file.

I/O. Source: https://www.sqlite.org/lang_transaction.html.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal

from gdp.closing import ClosedOnExit
from gdp.errors import StoreError

_LOCKED_S: Final = 10.0  # wait for another writing process


class TransactionFile(ClosedOnExit):
    """Opened file; ``tables`` are the statements that make its tables where they are not there.

    Args:
        synchronous: FULL: what is committed stays after a power cut; NORMAL: after a crash of the process.

    Raises:
        StoreError: it cannot be read or written now; every method may raise this too.
    """

    def __init__(self, path: Path, tables: str, *, synchronous: Literal["FULL", "NORMAL"] = "FULL") -> None:
        self.path = path
        self._lock = threading.Lock()
        with self._translated():
            path.touch(0o600)  # opens no present file: to close it would drop the locks that this process has on it
            self._file = sqlite3.connect(path, timeout=_LOCKED_S, isolation_level=None, check_same_thread=False)
            try:
                self._file.execute("PRAGMA journal_mode=WAL")
                self._file.execute(f"PRAGMA synchronous={synchronous}")
                self._file.executescript(tables)
            except (sqlite3.Error, UnicodeDecodeError):
                self._file.close()
                raise

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """Return a transaction, which is committed at its end, or rolled back at an error."""
        with self._translated(), self._lock:
            self._file.execute("BEGIN IMMEDIATE")
            with self._file:  # commits, or rolls back
                yield self._file

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Return the file for queries; other threads wait meanwhile."""
        with self._translated(), self._lock:
            yield self._file

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            raise StoreError(f"{self.path}: {error}") from error
        except UnicodeDecodeError as error:  # text of a damaged file, also within error messages of sqlite3
            raise StoreError(f"{self.path}: not a text: {error}") from error
