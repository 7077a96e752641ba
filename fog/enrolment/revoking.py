"""Revocation of the memberships of machines that are gone, in a switch's folder.

I/O; writes into the ``revocations`` folder of a switch.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.crypto.statements import parse
from gdp.errors import StatementError
from gdp.limits import CLOCK_SKEW_S
from gdp.stores.audit_log import note_once
from gdp.stores.files import public, read_public, write_all
from gdp.stores.keyring import load_domain
from gdp.trust.audit import Action
from gdp.trust.revocation import Revocation

__all__ = ["revoke_credentials"]

_SUFFIX: Final = ".revoke"
_TITLE_CHARS: Final = 32  # of the fingerprint


def revoke_credentials(
    domain: Path, folder: Path, fingerprints: Iterable[str], *, until_unix_s: float, unix_s: float
) -> bool:
    """Write a revocation for each membership and remove expired ones; return whether one is new.

    Args:
        fingerprints: in hex.

    Raises:
        LocalError: the domain is missing, or the folder cannot be written.
    """
    authority = load_domain(domain)
    files = {}
    for fingerprint in fingerprints:
        name = fingerprint[:_TITLE_CHARS] + _SUFFIX
        if not (folder / name).exists():
            body = bytes.fromhex(fingerprint)
            files[name] = public(Revocation.make(authority.key, authority.root.signer, body, int(until_unix_s)))
            note_once(domain, Action.REVOKED, "membership", about=fingerprint, unix_s=unix_s)
    write_all(folder, files)
    for path in folder.glob(f"[!.]*{_SUFFIX}"):
        with suppress(StatementError):  # not written by this function: left unchanged
            old = Revocation.from_statement(parse(read_public(path)))
            if old.until_unix_s + 2 * CLOCK_SKEW_S < unix_s:
                path.unlink(missing_ok=True)
    return bool(files)
