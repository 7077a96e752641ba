"""Ledger of a trust domain: every membership that its root key signed, in ``issued.jsonl`` in the key's directory.

I/O; times come in as arguments.
The file has one JSON object per line, appended and synced before the certificate is handed out. Each line holds the
SHA-256 of the line before it, which reveals a changed, removed or inserted line. A ledger whose last lines were cut off
is still consistent: keep a copy of the last hash elsewhere to detect that. A line without its end was never handed out,
and the next append drops it.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, Final

from gdp.crypto.certificates import Membership
from gdp.errors import LocalError
from gdp.stores.files import cut_unfinished_line, open_locked, sync
from gdp.stores.ownership import refuse_shared_folder

LEDGER: Final = "issued.jsonl"
_BEGIN: Final = "0" * 64  # the previous hash of the first line
_LINE_MAX_BYTES: Final = 16 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Issued:
    """One signed membership.

    Args:
        name, domain: of the node and of the trust domain, 64 hex digits each.
        fingerprint: SHA-256 of the certificate, hex.
        previous: SHA-256 of the line before, hex.
    """

    at_unix_s: int
    name: str
    role: str
    label: str
    domain: str
    fingerprint: str
    from_unix_s: int
    until_unix_s: int
    previous: str

    def to_line(self) -> bytes:
        """Return the line, without its end."""
        return json.dumps(asdict(self), sort_keys=True).encode()


def append_issued(directory: Path, member: Membership, unix_s: float) -> None:
    """Record a membership; the record is on the disk when the call returns.

    Raises:
        LocalError: the ledger is another user's, is inconsistent at its end, or cannot be written. The membership must
            not be handed out then.
    """
    path = directory / LEDGER
    validity = member.validity
    with open_locked(path, os.O_RDWR | os.O_CREAT) as file:
        refuse_shared_folder(directory)
        previous = _last_hash(path, file)
        line = Issued(
            at_unix_s=int(unix_s),
            name=member.name.to_text(),
            role=member.role.value,
            label=member.label,
            domain=member.domain.to_text(),
            fingerprint=member.fingerprint.hex(),
            from_unix_s=validity.not_before_unix_s,
            until_unix_s=validity.not_after_unix_s,
            previous=previous,
        ).to_line()
        file.write(line + b"\n")
        file.flush()
        os.fsync(file.fileno())
    sync(directory)


def read_ledger(directory: Path) -> list[Issued]:
    """Return the memberships of a domain, the oldest first; empty if none was recorded yet.

    Raises:
        LocalError: a line is malformed, or does not follow from the line before; the text names it.
    """
    path = directory / LEDGER
    if not path.exists():
        return []
    found: list[Issued] = []
    previous = _BEGIN
    with open_locked(path, os.O_RDONLY) as file:
        refuse_shared_folder(directory)
        for number, line in enumerate(iter(lambda: file.readline(_LINE_MAX_BYTES), b""), 1):
            if not line.endswith(b"\n"):
                break  # it was never handed out
            issued = _parsed(f"{path}:{number}", line)
            if issued.previous != previous:
                raise LocalError(f"{path}:{number}: does not follow from the line before: the ledger was changed")
            found.append(issued)
            previous = _hash(line)
    return found


def _last_hash(path: Path, file: BinaryIO) -> str:
    """Return the hash of the last whole line, and truncate the file after it."""
    line = cut_unfinished_line(path, file, _LINE_MAX_BYTES)
    if line is None:
        return _BEGIN
    _parsed(f"{path}: last line", line)
    return _hash(line)


def _parsed(where: str, line: bytes) -> Issued:
    try:
        issued = Issued(**json.loads(line))
    except (ValueError, TypeError, RecursionError) as error:
        raise LocalError(f"{where}: not a line of a ledger: {error}") from error
    if issued.to_line() != line.rstrip(b"\n"):
        raise LocalError(f"{where}: not a line as the ledger writes it")
    return issued


def _hash(line: bytes) -> str:
    return hashlib.sha256(line.rstrip(b"\n")).hexdigest()
