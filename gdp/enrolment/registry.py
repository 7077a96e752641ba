"""Registry of a domain: its join tokens, its machines and their memberships, and the mail that waits for them.

I/O, one SQLite file, private. The commands ``gdp domain token``, ``ls`` and ``remove`` and the running server use it at
the same time. A token is marked as used, on disk, before anything is issued for it: a crash at any point never lets a
second key use it. Of a token the file holds the id and the MAC key, not the secret. A launcher's plan of a machine
belongs to its token, and so does a misuse of the token, which is reported until the launcher has handled it.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gdp.crypto.certificates import Membership
from gdp.errors import LocalError, StoreError
from gdp.intervals import DAY_S
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.files import write_all
from gdp.stores.transactions import TransactionFile
from gdp.trust.enrolment_wire import EnrolmentError, Refusal
from gdp.trust.right import Right

MAILBOX_MAX: Final = 1_024  # mails that wait for one node
MAILBOX_MAX_BYTES: Final = 4 << 20
_SENDER_MAX: Final = MAILBOX_MAX // 4  # of them, by the nodes of one machine
_SENDER_MAX_BYTES: Final = MAILBOX_MAX_BYTES // 4
_FILE: Final = "registry.sqlite3"
_TABLES: Final = """
CREATE TABLE IF NOT EXISTS tokens (
  id BLOB PRIMARY KEY, mac BLOB NOT NULL, role TEXT NOT NULL, label TEXT NOT NULL,
  made_unix_s REAL NOT NULL, expires_unix_s REAL NOT NULL,
  keys BLOB, used_unix_s REAL, machine INTEGER, answer BLOB
) STRICT;
CREATE TABLE IF NOT EXISTS plans (
  token BLOB PRIMARY KEY, machine INTEGER, grants TEXT NOT NULL, until_unix_s REAL NOT NULL,
  misuse TEXT, is_reported INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE TABLE IF NOT EXISTS machines (
  id INTEGER PRIMARY KEY AUTOINCREMENT, label TEXT NOT NULL, role TEXT NOT NULL, joined_unix_s REAL NOT NULL,
  seen_unix_s REAL NOT NULL DEFAULT 0, removed_unix_s REAL, has_double INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE UNIQUE INDEX IF NOT EXISTS labels ON machines (label) WHERE removed_unix_s IS NULL;
CREATE TABLE IF NOT EXISTS nodes (
  name BLOB PRIMARY KEY, machine INTEGER NOT NULL, role TEXT NOT NULL, certificate BLOB NOT NULL,
  until_unix_s INTEGER NOT NULL, card BLOB
) STRICT;
CREATE TABLE IF NOT EXISTS certificates (
  fingerprint BLOB PRIMARY KEY, name BLOB NOT NULL, until_unix_s INTEGER NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS mail (
  id INTEGER PRIMARY KEY AUTOINCREMENT, recipient BLOB NOT NULL, sender BLOB NOT NULL, wire BLOB NOT NULL
) STRICT;
CREATE INDEX IF NOT EXISTS mailboxes ON mail (recipient, id);
"""
_MAILBOX: Final = "SELECT count(*), coalesce(sum(length(wire)), 0) FROM mail WHERE recipient = ?"
_SAME_MACHINE: Final = "(SELECT name FROM nodes WHERE machine = (SELECT machine FROM nodes WHERE name = ?))"
_MACHINE: Final = (
    "SELECT m.id, m.label, m.role, m.joined_unix_s, m.seen_unix_s, m.removed_unix_s, m.has_double,"
    " p.until_unix_s AS end_unix_s FROM machines m LEFT JOIN plans p ON p.machine = m.id"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A launcher's plan of a machine, which no request changes.

    Args:
        grants: names that its proxy is delegated, each with its right.
        until_unix_s: end of everything that is issued for it.
        is_misused: its token was misused; further requests are refused.
    """

    grants: Sequence[tuple[Metadata, Right]]
    until_unix_s: float
    is_misused: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class TokenRow:
    """A stored token.

    Args:
        mac: ``join_key`` of its secret.
        label: the one that its machine must have; empty: any.
        keys: SHA-256 of the keys that used it; None: not used.
        answer: the response to these keys; None: not complete.
        plan: of a launcher; None: there is none, or it was withdrawn.
    """

    id: bytes
    mac: bytes = field(repr=False)
    role: str
    label: str
    expires_unix_s: float
    keys: bytes | None
    used_unix_s: float | None
    machine: int | None
    answer: bytes | None = field(repr=False)
    plan: Plan | None


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeRow:
    """A node of a machine; ``card``: its descriptor, or None before it has finished joining."""

    name: Name
    role: str
    certificate: bytes = field(repr=False)
    until_unix_s: int
    card: bytes | None = field(repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineRow:
    """A machine of the domain.

    Args:
        seen_unix_s: when its agent was last connected; 0: never.
        removed_unix_s: when it was removed; None: it is a member.
        has_double: two machines were seen with its identity.
        end_unix_s: when everything that is issued for it ends; None: no launcher planned that.
    """

    id: int
    label: str
    role: str
    joined_unix_s: float
    seen_unix_s: float
    removed_unix_s: float | None
    has_double: bool
    end_unix_s: float | None
    nodes: tuple[NodeRow, ...]

    @property
    def until_unix_s(self) -> int:
        """Return when the first of its memberships ends."""
        return min((each.until_unix_s for each in self.nodes), default=0)


@dataclass(frozen=True, slots=True)
class StoredMail:
    """A mail that waits."""

    id: int
    wire: bytes = field(repr=False)


class Registry(TransactionFile):
    """The opened registry of a domain; threads may share it.

    Raises:
        LocalError: other users may write to the folder.
        StoreError: the file cannot be read or written now; every method may raise this too.
    """

    def __init__(self, folder: Path) -> None:
        write_all(folder, {})
        super().__init__(folder / _FILE, _TABLES)

    # tokens

    def add_token(
        self,
        identifier: bytes,
        mac: bytes,
        *,
        role: str,
        label: str,
        unix_s: float,
        expires_unix_s: float,
        plan: Plan | None = None,
    ) -> None:
        """Store a token, and the plan of its machine; those that ended long ago are deleted."""
        with self.writing() as file:
            file.execute("DELETE FROM plans WHERE until_unix_s < ?", (unix_s,))
            file.execute(
                "DELETE FROM tokens WHERE expires_unix_s < ? AND id NOT IN (SELECT token FROM plans)",
                (unix_s - 30 * DAY_S,),  # kept after its end, so that its refusal can say why
            )
            if plan is not None:
                grants = json.dumps([[dict(metadata), right.value] for metadata, right in plan.grants])
                file.execute(
                    "INSERT INTO plans (token, grants, until_unix_s) VALUES (?, ?, ?)",
                    (identifier, grants, plan.until_unix_s),
                )
            file.execute(
                "INSERT INTO tokens (id, mac, role, label, made_unix_s, expires_unix_s) VALUES (?, ?, ?, ?, ?, ?)",
                (identifier, mac, role, label, unix_s, expires_unix_s),
            )

    def find_token(self, identifier: bytes) -> TokenRow | None:
        """Return the token with this id."""
        query = (
            "SELECT t.id, mac, role, label, expires_unix_s, keys, used_unix_s, t.machine, answer, grants, until_unix_s,"
            " misuse FROM tokens t LEFT JOIN plans p ON p.token = t.id WHERE t.id = ?"
        )
        with self.reading() as file:
            found = _find(file, query, identifier)
        if found is None:
            return None
        grants, until_unix_s, misuse = (found.pop(each) for each in ("grants", "until_unix_s", "misuse"))
        return TokenRow(**found, plan=None if grants is None else _plan(grants, until_unix_s, misuse))

    def use_token(self, identifier: bytes, keys: bytes, label: str, unix_s: float) -> int:
        """Mark a token as used by these keys and reserve the label; return the machine's id.

        Of several requests at once exactly one succeeds; the same keys may repeat it.

        Raises:
            EnrolmentError: USED by other keys, LABEL_TAKEN, or NO_MEMBER: its machine was removed since. Nothing has
                changed then.
        """
        with self.writing() as file:
            row = file.execute("SELECT keys, machine, role FROM tokens WHERE id = ?", (identifier,)).fetchone()
            if row is None or (row[0] is not None and row[0] != keys):
                raise EnrolmentError(Refusal.USED, "this token was used already")
            if row[1] is not None:
                _refuse_removed(file, row[1])
                return int(row[1])
            machine = self._insert_machine(file, label, row[2], unix_s)
            file.execute(
                "UPDATE tokens SET keys = ?, used_unix_s = ?, machine = ? WHERE id = ?",
                (keys, unix_s, machine, identifier),
            )
            file.execute("UPDATE plans SET machine = ? WHERE token = ?", (machine, identifier))
            return machine

    def withdraw_tokens(self, label: str) -> None:
        """Delete the unused tokens for machines with this label, and the plans of these machines."""
        with self.writing() as file:
            file.execute("DELETE FROM plans WHERE token IN (SELECT id FROM tokens WHERE label = ?)", (label,))
            file.execute("DELETE FROM tokens WHERE label = ? AND keys IS NULL", (label,))

    def set_misused(self, identifier: bytes, detail: str) -> None:
        """Invalidate the token of a planned machine, and report that once; an earlier report stays."""
        with self.writing() as file:
            file.execute("UPDATE plans SET misuse = ? WHERE token = ? AND misuse IS NULL", (detail, identifier))

    def misuses(self) -> list[tuple[str, str]]:
        """Return label and detail of each misused token that was not yet ``reported``."""
        query = (
            "SELECT t.label, p.misuse FROM plans p JOIN tokens t ON t.id = p.token"
            " WHERE p.misuse IS NOT NULL AND p.is_reported = 0"
        )
        with self.reading() as file:
            return [(label, detail) for label, detail in file.execute(query).fetchall()]

    def reported(self, label: str) -> None:
        """Note that the misuse of a machine's token was handled."""
        with self.writing() as file:
            query = "UPDATE plans SET is_reported = 1 WHERE token IN (SELECT id FROM tokens WHERE label = ?)"
            file.execute(query, (label,))

    def complete_token(self, identifier: bytes, machine: int, members: Sequence[Membership], answer: bytes) -> None:
        """Store what was issued for a token, and the response to a repeat of its request.

        Raises:
            EnrolmentError: NO_MEMBER, the machine was removed meanwhile; what was issued must not be handed out.
        """
        with self.writing() as file:
            _refuse_removed(file, machine)
            for each in members:
                _insert_node(file, machine, each)
            file.execute("UPDATE tokens SET answer = ? WHERE id = ?", (answer, identifier))

    # machines

    def add_machine(self, label: str, role: str, members: Sequence[Membership], unix_s: float) -> int:
        """Store a machine that joined without a token; return its id. Raises ``EnrolmentError``: LABEL_TAKEN."""
        with self.writing() as file:
            machine = self._insert_machine(file, label, role, unix_s)
            for each in members:
                _insert_node(file, machine, each)
        return machine

    def renewed(self, members: Sequence[Membership]) -> None:
        """Store renewed memberships of known nodes.

        Raises:
            EnrolmentError: NO_MEMBER, their machine was removed meanwhile; they must not be handed out.
        """
        with self.writing() as file:
            for each in members:
                row = file.execute("SELECT machine FROM nodes WHERE name = ?", (each.name,)).fetchone()
                _refuse_removed(file, 0 if row is None else row[0])
                file.execute(
                    "UPDATE nodes SET certificate = ?, until_unix_s = ? WHERE name = ?",
                    (each.wire, each.not_after_unix_s, each.name),
                )
                _insert_certificate(file, each)

    def set_card(self, name: Name, card: bytes) -> None:
        """Store a node's descriptor."""
        with self.writing() as file:
            file.execute("UPDATE nodes SET card = ? WHERE name = ?", (card, name))

    def machine_of(self, name: Name) -> MachineRow | None:
        """Return the machine of a node, also a removed one."""
        return self._machine("SELECT machine FROM nodes WHERE name = ?", name)

    def machine(self, machine: int) -> MachineRow | None:
        """Return the machine with this id, also a removed one."""
        return self._machine("SELECT id FROM machines WHERE id = ?", machine)

    def machine_with(self, label: str, *, with_removed: bool = False) -> MachineRow | None:
        """Return the member machine with this label, or else the one that was removed last."""
        condition = "" if with_removed else " AND removed_unix_s IS NULL"
        order = "ORDER BY removed_unix_s IS NULL DESC, id DESC LIMIT 1"
        return self._machine(f"SELECT id FROM machines WHERE label = ?{condition} {order}", label)

    def machines(self, *, after: str = "", limit: int = 1 << 20, with_removed: bool = False) -> list[MachineRow]:
        """Return machines in the order of their labels, beginning after a label."""
        condition = "" if with_removed else " AND removed_unix_s IS NULL"
        query = f"SELECT id FROM machines WHERE label > ?{condition} ORDER BY label, id LIMIT ?"
        with self.reading() as file:
            found = [row[0] for row in file.execute(query, (after, limit)).fetchall()]
            return [self._row(file, each) for each in found]

    def saw(self, machine: int, unix_s: float) -> None:
        """Note that a machine's agent is connected."""
        with self.writing() as file:
            file.execute("UPDATE machines SET seen_unix_s = ? WHERE id = ?", (unix_s, machine))

    def set_double(self, machine: int) -> None:
        """Note that two machines run with the identity of this one."""
        with self.writing() as file:
            file.execute("UPDATE machines SET has_double = 1 WHERE id = ?", (machine,))

    def remove_machine(self, machine: int, unix_s: float) -> list[tuple[bytes, int]]:
        """Mark a machine as removed; return fingerprint and end of every membership of it that is still valid."""
        with self.writing() as file:
            file.execute(
                "UPDATE machines SET removed_unix_s = ? WHERE id = ? AND removed_unix_s IS NULL", (unix_s, machine)
            )
            file.execute("DELETE FROM mail WHERE recipient IN (SELECT name FROM nodes WHERE machine = ?)", (machine,))
            return [
                (fingerprint, until)
                for fingerprint, until in file.execute(
                    "SELECT fingerprint, until_unix_s FROM certificates WHERE until_unix_s >= ? AND name IN"
                    " (SELECT name FROM nodes WHERE machine = ?)",
                    (int(unix_s - DAY_S), machine),
                ).fetchall()
            ]

    def fingerprints(self, machine: int) -> frozenset[bytes]:
        """Return the fingerprints of all memberships that the nodes of a machine ever had."""
        query = "SELECT fingerprint FROM certificates WHERE name IN (SELECT name FROM nodes WHERE machine = ?)"
        with self.reading() as file:
            return frozenset(row[0] for row in file.execute(query, (machine,)).fetchall())

    # mail

    def add_mail(self, recipient: Name, sender: Name, wire: bytes) -> None:
        """Store a mail. Raises ``EnrolmentError``: MAILBOX_FULL, or NO_MEMBER: no such recipient."""
        with self.writing() as file:
            known = file.execute(
                "SELECT 1 FROM nodes n JOIN machines m ON m.id = n.machine"
                " WHERE n.name = ? AND m.removed_unix_s IS NULL",
                (recipient,),
            ).fetchone()
            if known is None:
                raise EnrolmentError(Refusal.NO_MEMBER, "the recipient is no member of this domain")
            count, size = file.execute(_MAILBOX, (recipient,)).fetchone()
            own_count, own_size = file.execute(
                f"{_MAILBOX} AND sender IN {_SAME_MACHINE}", (recipient, sender)
            ).fetchone()
            is_full = count >= MAILBOX_MAX or size + len(wire) > MAILBOX_MAX_BYTES
            if is_full or own_count >= _SENDER_MAX or own_size + len(wire) > _SENDER_MAX_BYTES:
                raise EnrolmentError(Refusal.MAILBOX_FULL, "the recipient's mailbox is full; its machine may be off")
            file.execute("INSERT INTO mail (recipient, sender, wire) VALUES (?, ?, ?)", (recipient, sender, wire))

    def mail_of(self, recipient: Name, since: int, limit: int) -> list[StoredMail]:
        """Return the mail of a node after an id; mail up to that id was fetched and is deleted."""
        with self.writing() as file:
            file.execute("DELETE FROM mail WHERE recipient = ? AND id <= ?", (recipient, since))
            rows = file.execute(
                "SELECT id, wire FROM mail WHERE recipient = ? ORDER BY id LIMIT ?", (recipient, limit)
            ).fetchall()
        return [StoredMail(number, wire) for number, wire in rows]

    def has_mail(self, recipient: Name) -> bool:
        """Return whether mail waits for a node."""
        with self.reading() as file:
            query = "SELECT 1 FROM mail WHERE recipient = ? LIMIT 1"
            return file.execute(query, (recipient,)).fetchone() is not None

    def _insert_machine(self, file: sqlite3.Connection, label: str, role: str, unix_s: float) -> int:
        query = "SELECT 1 FROM machines WHERE label = ? AND removed_unix_s IS NULL"
        if file.execute(query, (label,)).fetchone() is not None:
            raise EnrolmentError(
                Refusal.LABEL_TAKEN,
                f"the label {label!r} is taken by another machine of this domain: choose one with --label, or remove"
                " that machine first",
            )
        cursor = file.execute(
            "INSERT INTO machines (label, role, joined_unix_s) VALUES (?, ?, ?)", (label, role, unix_s)
        )
        return int(cursor.lastrowid or 0)

    def _machine(self, query: str, key: object) -> MachineRow | None:
        with self.reading() as file:
            row = file.execute(query, (key,)).fetchone()
            return None if row is None else self._row(file, row[0])

    def _row(self, file: sqlite3.Connection, machine: int) -> MachineRow:
        found = _find(file, f"{_MACHINE} WHERE m.id = ?", machine)
        if found is None:
            raise StoreError(f"{self.path}: a node of no machine")
        rows = file.execute(
            "SELECT name, role, certificate, until_unix_s, card FROM nodes WHERE machine = ? ORDER BY rowid", (machine,)
        ).fetchall()
        nodes = tuple(
            NodeRow(name=Name(name), role=each, certificate=certificate, until_unix_s=until, card=card)
            for name, each, certificate, until, card in rows
        )
        return MachineRow(**{**found, "has_double": bool(found["has_double"])}, nodes=nodes)


def _find(file: sqlite3.Connection, query: str, key: object) -> dict[str, Any] | None:
    """Return the first row of a query by its columns."""
    cursor = file.cursor()
    cursor.row_factory = sqlite3.Row
    row = cursor.execute(query, (key,)).fetchone()
    return None if row is None else dict(row)


def _plan(grants: str, until_unix_s: float, misuse: str | None) -> Plan:
    named = [(Metadata(metadata), Right(right)) for metadata, right in json.loads(grants)]
    return Plan(grants=named, until_unix_s=until_unix_s, is_misused=misuse is not None)


def _refuse_removed(file: sqlite3.Connection, machine: int) -> None:
    query = "SELECT 1 FROM machines WHERE id = ? AND removed_unix_s IS NULL"
    if file.execute(query, (machine,)).fetchone() is None:
        raise EnrolmentError(Refusal.NO_MEMBER, "this machine was removed from the domain; join again with a new token")


def _insert_node(file: sqlite3.Connection, machine: int, member: Membership) -> None:
    known = file.execute("SELECT machine FROM nodes WHERE name = ?", (member.name,)).fetchone()
    if known is not None and known[0] != machine:
        raise LocalError("a node of another machine")
    file.execute(
        "INSERT OR REPLACE INTO nodes (name, machine, role, certificate, until_unix_s) VALUES (?, ?, ?, ?, ?)",
        (member.name, machine, member.role.value, member.wire, member.not_after_unix_s),
    )
    _insert_certificate(file, member)


def _insert_certificate(file: sqlite3.Connection, member: Membership) -> None:
    file.execute(
        "INSERT OR REPLACE INTO certificates VALUES (?, ?, ?)",
        (member.fingerprint, member.name, member.not_after_unix_s),
    )
