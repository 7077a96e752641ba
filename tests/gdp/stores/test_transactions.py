"""SQLite files that threads and processes share."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gdp.errors import StoreError
from gdp.stores.transactions import TransactionFile

TABLES = "CREATE TABLE IF NOT EXISTS t (n INTEGER) STRICT;"
WRITE = f"""
import sys
from pathlib import Path
from gdp.stores.transactions import TransactionFile
file = TransactionFile(Path(sys.argv[1]), "{TABLES}")
with file.writing() as base:
    base.execute("INSERT INTO t VALUES (?)", (int(sys.argv[2]),))
file.close()
"""


def numbers(file: TransactionFile) -> list[int]:
    with file.reading() as base:
        return [number for (number,) in base.execute("SELECT n FROM t ORDER BY n").fetchall()]


def test_what_another_process_writes_is_seen_though_this_one_opened_the_file_twice(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite3"
    file = TransactionFile(path, TABLES)
    for number in range(3):
        TransactionFile(path, TABLES).close()
        subprocess.run([sys.executable, "-c", WRITE, str(path), str(number)], check=True)
        assert numbers(file) == [*range(number + 1)]
    assert path.stat().st_mode & 0o777 == 0o600
    file.close()


def test_a_transaction_that_fails_leaves_nothing(tmp_path: Path) -> None:
    file = TransactionFile(tmp_path / "a.sqlite3", TABLES)

    def write() -> None:
        with file.writing() as base:
            base.execute("INSERT INTO t VALUES (1)")
            base.execute("INSERT INTO t VALUES ('one')")

    with pytest.raises(StoreError, match="cannot store TEXT"):
        write()
    assert numbers(file) == []
    file.close()


def test_a_file_that_is_no_database_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite3"
    path.write_bytes(b"no database at all" * 100)
    with pytest.raises(StoreError, match=r"a\.sqlite3: file is not a database"):
        TransactionFile(path, TABLES)
