"""Journal of a site: desired clusters, machines and events, in one SQLite file.

I/O. An intention is written before its action; after a crash in between, the next reconciliation finds the machine by
name. Commands write the desired state, the supervisor everything else; both may have the file open at once.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError

from fog.cluster import ClusterPlan
from fog.supervisor.core.record import Record
from gdp.config.schema import first_fault
from gdp.errors import LocalError, StoreError
from gdp.stores.transactions import TransactionFile

FINAL_LOGS: Final = "final logs"

_EVENTS_MAX: Final = 10_000  # older ones are deleted
_TABLES: Final = """
CREATE TABLE IF NOT EXISTS clusters (
  name TEXT PRIMARY KEY, plan TEXT NOT NULL, is_up INTEGER NOT NULL, why TEXT NOT NULL,
  begun_unix_s REAL NOT NULL, machines INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE TABLE IF NOT EXISTS machines (
  cluster TEXT NOT NULL, name TEXT NOT NULL, is_gone INTEGER NOT NULL, record TEXT NOT NULL,
  PRIMARY KEY (cluster, name)
) STRICT;
CREATE TABLE IF NOT EXISTS events (
  id INTEGER PRIMARY KEY AUTOINCREMENT, unix_s REAL NOT NULL, cluster TEXT NOT NULL, machine TEXT NOT NULL,
  what TEXT NOT NULL, detail TEXT NOT NULL, since_unix_s REAL, lines TEXT NOT NULL DEFAULT ''
) STRICT;
"""
_RECORD: Final = TypeAdapter(Record)
_LATER: Final = {"since_unix_s": "REAL", "lines": "TEXT NOT NULL DEFAULT ''"}  # columns that an older journal lacks


@dataclass(frozen=True, slots=True)
class Cluster:
    """Desired state of a cluster.

    Args:
        is_up: whether its machines are wanted.
        why: reason why it is not up, in a few words.
        begun_unix_s: start of the cluster, for its cost and idle time.
    """

    plan: ClusterPlan
    is_up: bool
    why: str
    begun_unix_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """Event. ``machine`` is empty for an event of the whole cluster.

    Args:
        unix_s: time of the observation.
        since_unix_s: time of the event by the machine's or the provider's records; None: unknown.
        lines: for ``FINAL_LOGS``: final log lines of the program ``detail`` of a machine that is gone.
    """

    id: int
    unix_s: float
    cluster: str
    machine: str
    what: str
    detail: str
    since_unix_s: float | None = None
    lines: str = ""


_ENTRY_COLUMNS: Final = tuple(column.name for column in fields(Entry))


class Journal(TransactionFile):
    """Opened journal. Every method is one transaction.

    Raises:
        StoreError: it cannot be read or written now; every method may raise this too.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        super().__init__(path, _TABLES, synchronous="NORMAL")
        with self.reading() as file:
            has = {row[1] for row in file.execute("PRAGMA table_info(events)")}
            for column in _LATER.keys() - has:
                file.execute(f"ALTER TABLE events ADD COLUMN {column} {_LATER[column]}")

    def put_cluster(self, plan: ClusterPlan, now_s: float, *, why: str = "") -> None:
        """Write that a cluster is wanted; a running cluster of that name receives the new plan and continues."""
        with self.writing() as file:
            file.execute(
                "INSERT INTO clusters (name, plan, is_up, why, begun_unix_s) VALUES (?, ?, 1, '', ?)"
                " ON CONFLICT (name) DO UPDATE SET plan = excluded.plan, why = '',"
                " begun_unix_s = iif(is_up, begun_unix_s, excluded.begun_unix_s), is_up = 1",
                (plan.name, plan.to_json(), now_s),
            )
            _tell(file, now_s, plan.name, "", "wanted", why or f"{len(plan.machines)} machines")

    def unwant(self, name: str, why: str, now_s: float) -> None:
        """Write that a cluster is no longer wanted; a cluster that is not up is unchanged."""
        with self.writing() as file:
            if file.execute(
                "UPDATE clusters SET is_up = 0, why = ? WHERE name = ? AND is_up = 1", (why, name)
            ).rowcount:
                _tell(file, now_s, name, "", "down", why)

    def clusters(self) -> list[Cluster]:
        """Return all present and past clusters, in the order of their names."""
        with self.reading() as file:
            query = "SELECT name, plan, is_up, why, begun_unix_s FROM clusters ORDER BY name"
            rows = file.execute(query).fetchall()
        return [Cluster(self._plan(name, plan), bool(is_up), why, begun) for name, plan, is_up, why, begun in rows]

    def cluster(self, name: str) -> Cluster:
        """Return a cluster. Raises ``LocalError``: no cluster has that name."""
        found = {each.plan.name: each for each in self.clusters()}
        if name not in found:
            known = f"there are {', '.join(found)}" if found else "there is none"
            raise LocalError(f"no cluster is called {name}: {known}")
        return found[name]

    def next_machine(self, cluster: str) -> str:
        """Return a name that no machine of the cluster has ever had."""
        with self.writing() as file:
            (number,) = file.execute(
                "UPDATE clusters SET machines = machines + 1 WHERE name = ? RETURNING machines", (cluster,)
            ).fetchone()
        return f"m{number}"

    def put(
        self, record: Record, now_s: float, what: str = "", detail: str = "", since_unix_s: float | None = None
    ) -> None:
        """Write a machine's record, and an event if given; see ``Entry``."""
        spec = record.spec
        with self.writing() as file:
            file.execute(
                "INSERT OR REPLACE INTO machines (cluster, name, is_gone, record) VALUES (?, ?, ?, ?)",
                (spec.cluster, spec.name, record.is_gone, json.dumps(asdict(record), default=_plain)),
            )
            if what:
                _tell(file, now_s, spec.cluster, spec.name, what, detail, since_unix_s)

    def machines(self, cluster: str, *, gone: bool = True) -> list[Record]:
        """Return the machines of a cluster in the order of their requests."""
        query = "SELECT name, record FROM machines WHERE cluster = ?" + ("" if gone else " AND is_gone = 0")
        with self.reading() as file:
            rows = file.execute(query, (cluster,)).fetchall()
        return sorted((self._machine(cluster, *row) for row in rows), key=_number)

    def write_event(
        self,
        now_s: float,
        cluster: str,
        machine: str,
        what: str,
        detail: str = "",
        *,
        since_unix_s: float | None = None,
        lines: str = "",
    ) -> None:
        """Write an event; see ``Entry``."""
        with self.writing() as file:
            _tell(file, now_s, cluster, machine, what, detail, since_unix_s, lines)

    def stored_logs(self, cluster: str, machine: str) -> dict[str, str]:
        """Return program -> final log lines of a machine that failed or was preempted."""
        query = "SELECT detail, lines FROM events WHERE what = ? AND cluster = ? AND machine = ? ORDER BY id"
        with self.reading() as file:
            return dict(file.execute(query, (FINAL_LOGS, cluster, machine)).fetchall())

    def events(self, cluster: str = "", after: int = 0, last: int | None = None) -> list[Entry]:
        """Return events, oldest first.

        Args:
            after: id of the last known event.
            last: maximum number; the newest are returned.
        """
        query = (
            f"SELECT {', '.join(_ENTRY_COLUMNS)} FROM events"
            " WHERE id > ? AND (? = '' OR cluster = ?) ORDER BY id DESC LIMIT ?"
        )
        with self.reading() as file:
            rows = file.execute(query, (after, cluster, cluster, -1 if last is None else last)).fetchall()
        return [Entry(**dict(zip(_ENTRY_COLUMNS, row, strict=True))) for row in reversed(rows)]

    def last_event(self) -> int:
        """Return the id of the newest event; 0: there was none."""
        return max((each.id for each in self.events(last=1)), default=0)

    def _plan(self, name: str, plan: str) -> ClusterPlan:
        try:
            return ClusterPlan.from_json(plan)
        except LocalError as error:
            raise StoreError(f"{self.path}: clusters: {name}: {error}") from error

    def _machine(self, cluster: str, name: str, record: str) -> Record:
        try:
            return _RECORD.validate_json(record)
        except ValidationError as error:
            reason = first_fault(error)
            raise StoreError(f"{self.path}: machines: {cluster} {name}: not the record of one: {reason}") from error


def _tell(
    file: sqlite3.Connection,
    now_s: float,
    cluster: str,
    machine: str,
    what: str,
    detail: str,
    since_unix_s: float | None = None,
    lines: str = "",
) -> None:
    with closing(file.cursor()) as cursor:
        cursor.execute(
            "INSERT INTO events (unix_s, cluster, machine, what, detail, since_unix_s, lines)"
            " VALUES (?, ?, ?, ?, ?, ?, ?)",
            (now_s, cluster, machine, what, detail, since_unix_s, lines),
        )
        cursor.execute("DELETE FROM events WHERE id <= ?", ((cursor.lastrowid or 0) - _EVENTS_MAX,))


def _plain(value: object) -> object:
    if isinstance(value, Enum):
        return value.value
    raise TypeError(f"not for the journal: {value!r}")


def _number(record: Record) -> int:
    """Return the number in a machine's name, as assigned by ``next_machine``."""
    digits = record.name[1:]
    return int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 20 else 0
