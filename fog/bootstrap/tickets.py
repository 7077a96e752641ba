"""Store of enrolment tickets: planned seats, use of each ticket, and reports for the supervisor.

I/O, one folder of the site's state, private::

    responder.key       key to which requests are sealed
    tickets.sqlite3     one row per ticket, and news

A ticket is written before its machine is requested. It is marked as used, on disk, before anything is issued for it.
A crash at any point therefore never lets a second key obtain credentials. The threads of the responder and of the
supervisor use one object.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Final

from fog.cluster import ExportedInterface
from fog.credentials import IssuedCredentials
from gdp.crypto.certificates import Role
from gdp.crypto.kem import KemPrivateKey
from gdp.stores.files import private, read_private, write_all
from gdp.stores.transactions import TransactionFile
from gdp.trust.bootstrap_ticket import Seat, Ticket, token_id

__all__ = ["Kept", "News", "PlannedSeat", "Report", "Tickets"]

_KEY: Final = "responder.key"
_FILE: Final = "tickets.sqlite3"
_TABLES: Final = """
CREATE TABLE IF NOT EXISTS tickets (
  id BLOB PRIMARY KEY, token BLOB NOT NULL, cluster TEXT NOT NULL, machine TEXT NOT NULL, seats TEXT NOT NULL,
  expires_unix_s REAL NOT NULL, until_unix_s REAL NOT NULL,
  keys BLOB, answer BLOB, issued_credentials TEXT, is_reported INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE TABLE IF NOT EXISTS news (
  id INTEGER PRIMARY KEY AUTOINCREMENT, cluster TEXT NOT NULL, machine TEXT NOT NULL,
  report TEXT NOT NULL, detail TEXT NOT NULL, issued_credentials TEXT
) STRICT;
"""


class Report(Enum):
    """Kind of event of a ticket."""

    ENROLLED = "enrolled"
    MISUSED = "misused"  # the requester has the token, but is not the machine, or not the first to use it


@dataclass(frozen=True, slots=True)
class PlannedSeat:
    """Seat, and the interfaces that its member may provide (serve, publish)."""

    seat: Seat
    carried: tuple[ExportedInterface, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """Stored ticket.

    Args:
        expires_unix_s: end of the time in which it can be used.
        until_unix_s: end of validity of everything issued for it.
        keys: SHA-256 of the keys that used it; None: not used.
        answer: response to these keys; None: not complete yet.
        issued_credentials: credentials issued to the machine that used it.
        is_reported: a misuse was reported; further requests get no response.
    """

    token: bytes = field(repr=False)
    cluster: str
    machine: str
    seats: tuple[PlannedSeat, ...]
    expires_unix_s: float
    until_unix_s: float
    keys: bytes | None
    answer: bytes | None = field(repr=False)
    issued_credentials: IssuedCredentials | None
    is_reported: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class News:
    """Report for the supervisor, returned repeatedly until it is ``taken``."""

    id: int
    cluster: str
    machine: str
    report: Report
    detail: str
    issued_credentials: IssuedCredentials | None


class Tickets(TransactionFile):
    """Opened folder of tickets.

    Raises:
        LocalError: other users can access the folder.
        StoreError: it cannot be read or written now; every method may raise this too.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / _KEY).exists():
            write_all(folder, {_KEY: private(KemPrivateKey.generate().wire)})
        self.responder = KemPrivateKey.from_wire(read_private(folder / _KEY))
        super().__init__(folder / _FILE, _TABLES)

    def issue(
        self,
        cluster: str,
        machine: str,
        seats: Sequence[PlannedSeat],
        token: bytes,
        *,
        addresses: Sequence[str],
        unix_s: float,
        expires_unix_s: float,
        until_unix_s: float,
    ) -> Ticket:
        """Store and return a machine's ticket; expired tickets are deleted; ``token``: 32 random bytes."""
        with self.writing() as file:
            file.execute(
                "DELETE FROM tickets WHERE until_unix_s < ? OR (keys IS NULL AND expires_unix_s < ?)", (unix_s, unix_s)
            )
            file.execute(
                "INSERT INTO tickets (id, token, cluster, machine, seats, expires_unix_s, until_unix_s)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                (token_id(token), token, cluster, machine, _seats_text(seats), expires_unix_s, until_unix_s),
            )
        return Ticket(tuple(addresses), self.responder.public, token, tuple(each.seat for each in seats))

    def knows(self, identifier: bytes) -> bool:
        """Return whether a ticket has this id."""
        with self.reading() as file:
            return file.execute("SELECT 1 FROM tickets WHERE id = ?", (identifier,)).fetchone() is not None

    def find(self, identifier: bytes) -> Kept | None:
        """Return the ticket with this id."""
        query = (
            "SELECT token, cluster, machine, seats, expires_unix_s, until_unix_s, keys, answer, issued_credentials,"
            " is_reported FROM tickets WHERE id = ?"
        )
        with self.reading() as file:
            row = file.execute(query, (identifier,)).fetchone()
        if row is None:
            return None
        token, cluster, machine, seats, expires_unix_s, until_unix_s, keys, answer, issued_credentials, is_reported = (
            row
        )
        return Kept(
            token=token,
            cluster=cluster,
            machine=machine,
            seats=_seats(seats),
            expires_unix_s=expires_unix_s,
            until_unix_s=until_unix_s,
            keys=keys,
            answer=answer,
            issued_credentials=_issued_credentials(issued_credentials),
            is_reported=bool(is_reported),
        )

    def use(self, identifier: bytes, keys: bytes) -> bool:
        """Mark a ticket as used by these keys; return whether it was unused or used by the same keys."""
        with self.writing() as file:
            return bool(
                file.execute(
                    "UPDATE tickets SET keys = ? WHERE id = ? AND is_reported = 0 AND (keys IS NULL OR keys = ?)",
                    (keys, identifier, keys),
                ).rowcount
            )

    def complete(self, identifier: bytes, answer: bytes, issued_credentials: IssuedCredentials, detail: str) -> bool:
        """Store the response to a ticket's keys, and report it to the supervisor; False: the ticket was withdrawn."""
        text = json.dumps(asdict(issued_credentials))
        with self.writing() as file:
            if not file.execute(
                "UPDATE tickets SET answer = ?, issued_credentials = ? WHERE id = ?", (answer, text, identifier)
            ).rowcount:
                return False
            _tell(file, identifier, Report.ENROLLED, detail, text)
        return True

    def misused(self, identifier: bytes, detail: str) -> None:
        """Invalidate a ticket, and report that to the supervisor once."""
        with self.writing() as file:
            if file.execute(
                "UPDATE tickets SET is_reported = 1 WHERE id = ? AND is_reported = 0", (identifier,)
            ).rowcount:
                _tell(file, identifier, Report.MISUSED, detail, None)

    def delete(self, cluster: str, machine: str) -> None:
        """Delete the ticket of a machine that is gone; no effect if there is none."""
        with self.writing() as file:
            file.execute("DELETE FROM tickets WHERE cluster = ? AND machine = ?", (cluster, machine))

    def pending_reports(self) -> list[News]:
        """Return the news that was not ``taken`` yet, oldest first."""
        with self.reading() as file:
            rows = file.execute(
                "SELECT id, cluster, machine, report, detail, issued_credentials FROM news ORDER BY id"
            ).fetchall()
        return [
            News(
                id=number,
                cluster=cluster,
                machine=machine,
                report=Report(report),
                detail=detail,
                issued_credentials=_issued_credentials(issued_credentials),
            )
            for number, cluster, machine, report, detail, issued_credentials in rows
        ]

    def taken(self, news: News) -> None:
        """Delete news that was handled."""
        with self.writing() as file:
            file.execute("DELETE FROM news WHERE id = ?", (news.id,))


def _tell(
    file: sqlite3.Connection, identifier: bytes, report: Report, detail: str, issued_credentials: str | None
) -> None:
    file.execute(
        "INSERT INTO news (cluster, machine, report, detail, issued_credentials)"
        " SELECT cluster, machine, ?, ?, coalesce(?, issued_credentials) FROM tickets WHERE id = ?",
        (report.value, detail, issued_credentials, identifier),
    )


def _seats_text(seats: Sequence[PlannedSeat]) -> str:
    return json.dumps(
        [
            {**asdict(each.seat), "role": each.seat.role.value, "carried": [asdict(one) for one in each.carried]}
            for each in seats
        ]
    )


def _seats(text: str) -> tuple[PlannedSeat, ...]:
    return tuple(
        PlannedSeat(
            Seat(each["folder"], Role(each["role"]), each["label"]),
            tuple(ExportedInterface(**one) for one in each["carried"]),
        )
        for each in json.loads(text)
    )


def _issued_credentials(text: str | None) -> IssuedCredentials | None:
    if text is None:
        return None
    document = json.loads(text)
    return IssuedCredentials(document["proxy"], document["until_unix_s"], tuple(document["fingerprints"]))
