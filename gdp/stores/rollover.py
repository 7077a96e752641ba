"""Rollover of a trust domain's root: another key takes over, and both are trusted for a while.

I/O, through ``keyring``. ::

    begin    domain/next/root.key*  next/root.crt     the successor, which the present root vouches for
             (next/root.crt goes to every node that has the domain's root; memberships are issued as before)
    finish   domain/root.key*  root.crt  retired/root.key*     from now on the successor issues
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Root
from gdp.crypto.keys import SigningKey
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.intervals import DAY_S
from gdp.stores.audit_log import note_once
from gdp.stores.files import private, public, read_private, read_public, refuse_existing, write_all
from gdp.stores.keyring import ROOT_CERTIFICATE, ROOT_KEY, load_domain, load_root, save_domain
from gdp.trust.audit import Action

NEXT: Final = "next"
RETIRED: Final = "retired"


def begin_rollover(
    domain: Path,
    *,
    days: float,
    overlap_days: float,
    key: SigningKey | None = None,
    passphrase: bytes | None = None,
    unix_s: float | None = None,
) -> CertificateAuthority:
    """Make a successor of a domain's root; the domain continues to issue with the present one.

    Args:
        overlap_days: how long the present root is trusted together with it.
        key: the successor's key, if it exists already, for example in a token.
        passphrase: guards the successor's key file.

    Raises:
        LocalError: no domain is there, or a rollover has begun already.
    """
    now = time.time() if unix_s is None else unix_s
    refuse_existing(domain / NEXT)
    authority = load_domain(domain)
    retires_unix_s = int(now + overlap_days * DAY_S)
    successor = authority.succeed(key or SigningKey.generate(), Validity.lasting(now, days * DAY_S), retires_unix_s)
    save_domain(domain / NEXT, successor, passphrase=passphrase)
    _note(domain, "root that succeeds", successor.root, now)
    return successor


def finish_rollover(domain: Path) -> Root:
    """Issue with the successor from now on; the next call resumes after a kill.

    Raises:
        LocalError: no rollover has begun.
    """
    successor = domain / NEXT
    if not successor.is_dir():
        raise LocalError(f"{successor}: no rollover has begun: gdp cert rollover begin")
    root = load_root(successor / ROOT_CERTIFICATE)
    name = f"root-{len(root.predecessors)}.key"
    retired, present = domain / RETIRED / name, read_private(domain / ROOT_KEY)
    new = read_private(successor / ROOT_KEY)
    if present != new:
        write_all(retired.parent, {retired.name: private(present)}, force=True)
    write_all(domain, {ROOT_CERTIFICATE: public(root.to_pem())}, force=True)
    write_all(domain, {ROOT_KEY: private(new)}, force=True)
    for path in (successor / ROOT_CERTIFICATE, successor / ROOT_KEY):
        path.unlink()
    successor.rmdir()
    _note(domain, "root that issues", root, time.time())
    return root


def _note(domain: Path, what: str, root: Root, unix_s: float) -> None:
    who, about = root.key.compressed.hex(), root.domain.to_text()
    note_once(domain, Action.ACCEPTED, what, who=who, about=about, unix_s=unix_s)


def trust_successor(file: Path, root: Path) -> Root:
    """Replace a trusted root by one that descends from it.

    Args:
        file: the domain's newer root, with its predecessors.
        root: the file that a node's configuration names.

    Raises:
        LocalError: it does not descend from the trusted root, which then stays.
    """
    newer, present = load_root(file), load_root(root)
    if newer.domain != present.domain or present.key not in [each.key for each in newer.lineage]:
        raise LocalError(f"{file}: not vouched for by {root}, which stays as it is")
    write_all(root.parent, {root.name: public(read_public(file))}, force=True)
    return newer
