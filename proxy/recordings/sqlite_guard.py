"""Guard for untrusted SQLite databases: plain tables only, bounded work, bounded values.

I/O. A view or a virtual table may run any query. A tree of pages may be circular, and a value may be as long as its
header states. Source: "Defense Against The Dark Arts", https://www.sqlite.org/security.html.
"""

from __future__ import annotations

import os
from typing import Final

import apsw

from proxy.recordings.unpacking import CHUNK_MAX_BYTES, SalvageError

_STEPS_FREE: Final = 20_000_000  # steps of SQLite's virtual machine for one statement, about a second
_STEPS_PER_BYTE: Final = 16  # ... and this many for each byte of the file
_STEPS_BETWEEN: Final = 50_000  # interval, in steps, of signal handling and step counting
_TABLES_MAX: Final = 256
_PRAGMAS: Final = frozenset({"table_info", "writable_schema"})
_FUNCTIONS: Final = frozenset({"count", "min", "max"})


class _Steps:
    """Counts the steps of the running statement."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._left = limit

    def begin(self, cursor: object, statement: str, bindings: object) -> bool:
        del cursor, statement, bindings
        self._left = self._limit
        return True

    def count(self) -> bool:
        """Return whether the statement must end."""
        self._left -= _STEPS_BETWEEN
        return self._left < 0


def guard(connection: apsw.Connection) -> None:
    """Limit the statements on a connection. Call it before the first one."""
    try:
        size = os.stat(connection.filename).st_size
    except OSError:
        size = 0
    steps = _Steps(_STEPS_FREE + _STEPS_PER_BYTE * size)
    connection.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
    connection.config(apsw.SQLITE_DBCONFIG_ENABLE_VIEW, 0)
    connection.config(apsw.SQLITE_DBCONFIG_ENABLE_TRIGGER, 0)
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, CHUNK_MAX_BYTES)
    connection.authorizer = _authorize
    connection.exec_trace = steps.begin
    connection.set_progress_handler(steps.count, _STEPS_BETWEEN)


def check_schema(connection: apsw.Connection) -> None:
    """Refuse a database in which a name may denote anything but a table.

    Raises:
        SalvageError: there are views, triggers or virtual tables, or very many tables.
        apsw.Error: the schema cannot be read.
    """
    rows = connection.execute(f"SELECT type, sql FROM sqlite_master LIMIT {_TABLES_MAX + 1}").fetchall()
    for kind, sql in rows:
        words = sql.upper().split(None, 2)[:2] if isinstance(sql, str) else []
        if kind not in ("table", "index") or words == ["CREATE", "VIRTUAL"]:
            raise SalvageError("the database has views, triggers or virtual tables, which no recording has")
    if len(rows) > _TABLES_MAX:
        raise SalvageError(f"the database has more than {_TABLES_MAX} tables and indexes")


def _authorize(action: int, first: str | None, second: str | None, database: str | None, view: str | None) -> int:
    del database
    if view is None:
        if action in (apsw.SQLITE_SELECT, apsw.SQLITE_READ):
            return apsw.SQLITE_OK
        if action == apsw.SQLITE_PRAGMA and first in _PRAGMAS:
            return apsw.SQLITE_OK
        if action == apsw.SQLITE_FUNCTION and (second or "").lower() in _FUNCTIONS:
            return apsw.SQLITE_OK
    return apsw.SQLITE_DENY
