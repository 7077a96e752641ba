"""Salvage of a sqlite3 recording: read row by row, if the file is truncated or its journal was never merged.

I/O, reading only. A guard lets an untrusted database have plain tables, bounded work and bounded values only: a view or
a virtual table may run any query, a tree of pages may be circular, and a value may be as long as its header states.
Source: SQLite file format, section 1.3 (the header states the number of pages); rosbag2 schemas 1 to 4;
"Defense Against The Dark Arts", https://www.sqlite.org/security.html.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final, TypeAlias
from urllib.parse import quote

import apsw

from proxy.recordings.channels import from_ros2, offered_qos
from proxy.recordings.source import Message, Tally
from proxy.recordings.unpacking import CHUNK_MAX_BYTES, SalvageError
from proxy.serial.channel import Channel, DefinitionFormat

_STEPS_FREE: Final = 20_000_000  # steps of SQLite's virtual machine for one statement, about a second
_STEPS_PER_BYTE: Final = 16  # ... and this many for each byte of the file
_STEPS_BETWEEN: Final = 50_000  # interval, in steps, of signal handling and step counting
_TABLES_MAX: Final = 256
_PRAGMAS: Final = frozenset({"table_info", "writable_schema"})
_FUNCTIONS: Final = frozenset({"count", "min", "max"})
MAGIC: Final = b"SQLite format 3\0"
_DEFINITION: Final = ("topic_type", "encoding", "encoded_message_definition")
_TOPIC: Final = ("name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
_FORMATS: Final[dict[str, DefinitionFormat]] = {"ros2msg": "msg", "ros2idl": "idl"}


def _pages(path: Path) -> tuple[int, int]:
    """Return the bytes of a page and the number of pages in the header."""
    with path.open("rb") as file:
        head = file.read(100)
    page = int.from_bytes(head[16:18], "big")
    return (65_536 if page == 1 else page), int.from_bytes(head[28:32], "big")


def _missing_bytes(path: Path) -> int:
    size, count = _pages(path)
    return max(0, size * count - path.stat().st_size)


_Copy: TypeAlias = "tempfile.TemporaryDirectory[str] | None"


def _whole_pages(path: Path) -> tuple[_Copy, Path]:
    """Return a copy without the last, broken page, which SQLite would pad with zeros and read as data."""
    size, _ = _pages(path)
    whole = path.stat().st_size // max(1, size) * size
    if whole == path.stat().st_size:
        return None, path
    folder = tempfile.TemporaryDirectory(prefix="whole-pages-")
    copy = Path(folder.name) / path.name
    shutil.copyfile(path, copy)
    os.truncate(copy, whole)
    return folder, copy


def _with_index(path: Path) -> tuple[_Copy, Path]:
    """Return a copy of a database and its journal if the journal's index is missing: SQLite would write it."""
    if not _journal(path).exists() or path.with_name(path.name + "-shm").exists():
        return None, path
    folder = tempfile.TemporaryDirectory(prefix="journal-")
    copy = Path(folder.name) / path.name
    shutil.copyfile(path, copy)
    shutil.copyfile(_journal(path), _journal(copy))
    return folder, copy


def _journal(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


class SqliteSource:
    """The readable part of a database. Raises ``SalvageError``: not even its topics can be read."""

    def __init__(self, path: Path) -> None:
        self.channels: list[Channel] = []
        self.unread = ""
        self._left_out: list[str] = []
        self._index: dict[int, int] = {}  # topic id to index
        self._order: list[tuple[int, int, int]] = []  # stamp, row, topic id
        self._stats = Tally()
        self._stats.missing_bytes = _missing_bytes(path)
        self._stats.scanned_bytes = path.stat().st_size
        self._copy, file = _whole_pages(path) if self._stats.missing_bytes else _with_index(path)
        mode = "mode=ro" if _journal(file).exists() else "immutable=1"
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        try:
            self._db = apsw.Connection(f"file:{quote(str(file))}?{mode}", flags=flags)
        except apsw.Error as error:
            raise SalvageError(f"the database cannot be opened: {error}") from error
        guard(self._db)
        try:
            # Without this SQLite refuses a file with fewer pages than its header says.
            self._db.execute("PRAGMA writable_schema=ON")
            check_schema(self._db)
            self._read_topics()
        except (apsw.Error, TypeError, ValueError) as error:
            self.close()
            raise SalvageError(f"the database cannot be read: {error}") from error
        except SalvageError:
            self.close()
            raise
        self._find_messages()

    @property
    def count(self) -> int:
        """Return the number of messages found."""
        return len(self._order)

    @property
    def counts(self) -> list[int] | None:
        """Return the messages found of each channel."""
        found = Counter(topic for _, _, topic in self._order)
        return [found[topic] for topic in self._index]

    def messages(self) -> Iterator[Message]:
        """Yield messages in time order."""
        for stamp_ns, row, topic in self._order:
            try:
                with closing(self._db.execute("SELECT data FROM messages WHERE id = ?", (row,))) as rows:
                    found = rows.fetchone()
            except (apsw.Error, UnicodeDecodeError) as error:
                self.unread = self._stats.text(f"the message in row {row} cannot be read ({error})")
                continue
            if found is not None and isinstance(found[0], bytes):
                yield Message(self._index[topic], stamp_ns, found[0])
            else:
                self.unread = self._stats.text(f"the message in row {row} is not bytes")

    def close(self) -> None:
        """Close the database."""
        self._db.close()
        if self._copy is not None:
            self._copy.cleanup()

    def _columns(self, table: str) -> set[str]:
        with closing(self._db.execute(f"PRAGMA table_info({table})")) as rows:
            return {str(row[1]) for row in rows}

    def _read_topics(self) -> None:
        definitions: dict[str, tuple[DefinitionFormat, str]] = {}
        if self._columns("message_definitions"):
            for _, (type_name, encoding, text) in self._rows("message_definitions", _DEFINITION):
                definitions[type_name] = (_FORMATS.get(encoding, ""), text)
        for number, (topic, type_name, form, profiles, type_hash) in self._rows("topics", _TOPIC):
            if form != "cdr":
                self._left_out.append(f"topic {topic} is left out: it is in {form or 'no encoding'}, not CDR")
                continue
            definition_format, definition = definitions.get(type_name, ("", ""))
            qos = offered_qos(topic, profiles, self._left_out)
            self._index[number] = len(self.channels)
            self.channels.append(from_ros2(topic, type_name, type_hash, definition, definition_format, qos))

    def _rows(self, table: str, columns: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
        """Yield the number and the texts of each row; a column that is not there is empty, and UTF-8 is not assumed."""
        there = self._columns(table)
        key = "id" if "id" in there else "rowid"
        texts = ", ".join(f"CAST({column} AS BLOB)" if column in there else "x''" for column in columns)
        for number, *values in self._db.execute(f"SELECT {key}, {texts} FROM {table} ORDER BY {key}"):
            yield int(number), [(value or b"").decode("utf-8", "replace") for value in values]

    def _find_messages(self) -> None:
        reason = ""
        try:
            # The data is queried as well, so that a row whose pages are missing is detected here.
            rows = self._db.execute("SELECT id, topic_id, timestamp, CAST(data AS BLOB) FROM messages ORDER BY id")
            for row, topic, stamp_ns, _ in rows:
                if topic in self._index and isinstance(stamp_ns, int):
                    self._order.append((int(stamp_ns), int(row), int(topic)))
                    self._stats.messages += 1
        except apsw.Error as error:
            reason = f"the file ends in the middle ({error})"
        self._order.sort()
        if self._stats.missing_bytes and not reason:
            reason = "the file ends in the middle"
        self.unread = "; ".join([*([self._stats.text(reason)] if reason else []), *self._left_out])


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
