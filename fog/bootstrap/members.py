"""Issuing of memberships in the site's domain and of the owner's delegations, and revocation of memberships.

I/O; reads the domain's and the owner's private keys, and writes into the ``revocations`` folder of a switch. Keys of
members on this host are generated here and leave nothing on disk; machines generate their own keys.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fog.cluster import ExportedInterface
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.kem import KemPublicKey
from gdp.crypto.statements import parse
from gdp.crypto.subject import Subject
from gdp.errors import StatementError
from gdp.limits import CLOCK_SKEW_S
from gdp.metadata import Metadata
from gdp.stores.audit_log import note_once
from gdp.stores.files import public, read_public, write_all
from gdp.stores.issue import DAY_S, admit, delegate, make_node
from gdp.stores.keyring import CARD, OWNER_PUBLIC, load_domain, save_delegation
from gdp.trust.audit import Action
from gdp.trust.bootstrap_ticket import Application, Granted
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right

__all__ = ["Authority", "Enrolled", "metadata_of", "revoke_credentials", "right_of"]

_RIGHTS: Final = {"topic": (Right.PUBLISH, Right.READ)}
_CALLS: Final = (Right.SERVE, Right.CALL)
_SUFFIX: Final = ".revoke"
_TITLE_CHARS: Final = 32  # of the fingerprint


@dataclass(frozen=True, slots=True)
class Enrolled:
    """New member on this host: a gateway, or a node of the robot's side.

    Args:
        files: contents of its directory, private.
    """

    member: Membership
    files: Mapping[str, bytes]

    def below(self, folder: str) -> dict[str, bytes]:
        """Return its files with this folder prefixed to their names."""
        return {f"{folder}/{name}": data for name, data in self.files.items()}


@dataclass(frozen=True, slots=True)
class _Node:
    """Node that receives a delegation; one request proved both of its keys."""

    subject: Subject
    kem: KemPublicKey


@dataclass(frozen=True, slots=True)
class Authority:
    """Issuer of memberships and delegations: the directories of a domain and of an owner.

    Args:
        scratch: folder for temporary files; leftovers of a killed process may be deleted.
    """

    domain: Path
    owner: Path
    scratch: Path | None = None

    def enrol(self, role: Role, label: str, *, days: float) -> Enrolled:
        """Return a new member whose keys are generated here.

        Raises:
            LocalError: the domain or the owner is missing, or the root certificate has expired.
        """
        with tempfile.TemporaryDirectory(prefix="gdp-fog-", dir=self.scratch) as scratch:
            node = Path(scratch) / "node"
            identity = make_node(node, role, label, self.domain, days=days)
            files = {str(path.relative_to(node)): path.read_bytes() for path in node.rglob("*") if path.is_file()}
        return Enrolled(identity.member, files)

    def grant(
        self, application: Application, carried: Iterable[ExportedInterface], *, until_unix_s: float, unix_s: float
    ) -> tuple[Membership, Granted]:
        """Return the requested membership, and delegations to provide (serve, publish) the exported interfaces.

        The caller has checked that role and label are the planned ones.

        Raises:
            StatementError: the application is invalid.
            LocalError: as ``enrol``.
        """
        days = (until_unix_s - unix_s) / DAY_S
        member = admit(self.domain, application.request, days=days, unix_s=unix_s)
        node = _Node(member.subject, application.kem)
        given = [
            delegate(
                self.owner, node, metadata_of(each), [right_of(each, gives=True)], days=days, unix_s=unix_s
            ).to_wire()
            for each in carried
        ]
        return member, Granted(member.wire, tuple(given))

    def grant_access(self, node: Path, delegations: Path, carried: Iterable[ExportedInterface], *, days: float) -> None:
        """Delegate to a node of the robot's side to use (call, read) interfaces; earlier delegations are replaced.

        Raises:
            LocalError: as ``enrol``, or the node's directory has no node descriptor.
        """
        for each in carried:
            given = delegate(self.owner, node / CARD, metadata_of(each), [right_of(each, gives=False)], days=days)
            save_delegation(delegations, given, force=True)

    @property
    def owner_key(self) -> Path:
        """Return the path of the owner's public key."""
        return self.owner / OWNER_PUBLIC


def metadata_of(carried: ExportedInterface) -> Metadata:
    """Return the metadata that the overlay name of a service, action or topic hashes."""
    own = {"kind": carried.kind, "name": carried.name, "type": carried.type_name}
    more = carried.options.get("metadata", {})
    return Metadata({**own, **more} if isinstance(more, dict) else own)


def right_of(carried: ExportedInterface, *, gives: bool) -> Right:
    """Return the right needed to provide an interface, or to use it."""
    give, take = _RIGHTS.get(carried.kind, _CALLS)
    return give if gives else take


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
