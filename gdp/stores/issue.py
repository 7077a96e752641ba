"""Issuance of domains, nodes, owners and delegations, one call each, for the ``gdp`` command and for test networks.

I/O, through ``keyring``; reads the wall clock if no time is given. The domain's ledger records every membership before
it is handed out.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Membership, Role, Root, Unverified
from gdp.crypto.identity import Identity, NodeKeys, node_metadata
from gdp.crypto.keys import SigningKey
from gdp.crypto.server_certificate import issue_door_certificate
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import LocalError, StatementError
from gdp.intervals import DAY_S
from gdp.limits import CHAIN_MAX
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.audit_log import note_once
from gdp.stores.files import private, read_public, refuse_existing, write_all
from gdp.stores.keyring import (
    DELEGATIONS,
    NODE_CERTIFICATE,
    OWNER_KEY,
    OWNER_SALT,
    ROOT_CERTIFICATE,
    SUCCESSION,
    load_card,
    load_domain,
    load_identity,
    load_node_keys,
    load_owner,
    load_root,
    load_salt,
    parsed,
    save_delegation,
    save_domain,
    save_identity,
    save_membership,
    save_node_keys,
    save_owner,
    storage,
)
from gdp.stores.ledger import append_issued
from gdp.stores.private_keys import Storage
from gdp.trust.adcert import AdCertCache, Chain
from gdp.trust.audit import Action
from gdp.trust.delegation import Delegation
from gdp.trust.grants import SECRET_BYTES
from gdp.trust.node_descriptor import Recipient
from gdp.trust.owner import Owner
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert

ROOT_DAYS: Final = 3_650.0
MEMBER_DAYS: Final = 365.0
DELEGATION_DAYS: Final = 365.0
_SALT_BYTES: Final = 16


def make_domain(
    directory: Path,
    label: str,
    *,
    days: float = ROOT_DAYS,
    key: SigningKey | None = None,
    passphrase: bytes | None = None,
    force: bool = False,
    unix_s: float | None = None,
) -> CertificateAuthority:
    """Create a trust domain and keep its root in ``directory``.

    Args:
        key: the root's key, if it exists already, for example in a token.
        passphrase: guards the key's file.

    Raises:
        LocalError: the label is invalid, or a domain exists there already.
    """
    validity = Validity.lasting(_now(unix_s), days * DAY_S)
    authority = CertificateAuthority.create(label, key or SigningKey.generate(), validity)
    save_domain(directory, authority, passphrase=passphrase, force=force)
    return authority


def make_owner(
    directory: Path,
    *,
    key: SigningKey | None = None,
    passphrase: bytes | None = None,
    force: bool = False,
    is_salted: bool = False,
) -> Owner:
    """Make an owner's keys and keep them in ``directory``; ``key`` and ``passphrase`` as for ``make_domain``.

    Args:
        is_salted: the names that it shares get an unguessable part.

    Raises:
        LocalError: an owner exists there already.
    """
    owner = Owner(key or SigningKey.generate(), secrets.token_bytes(SECRET_BYTES))
    save_owner(directory, owner, passphrase=passphrase, force=force)
    if is_salted:
        write_all(directory, {OWNER_SALT: private(secrets.token_urlsafe(_SALT_BYTES).encode())}, force=force)
    return owner


def succeed_owner(
    owner: Path,
    successor: Path,
    names: Iterable[Subject],
    *,
    days: float,
    key: SigningKey | None = None,
    passphrase: bytes | None = None,
    unix_s: float | None = None,
) -> Owner:
    """Let a successor's key delegate names in place of an owner; the successor is made if it is missing.

    The successor has the owner's master secret, so the topics' secrets do not change.

    Args:
        names: names that it may delegate, in addition to those of earlier calls.
        days: duration; every delegation by the successor ends then.
        key, passphrase: of a new successor, as for ``make_domain``.

    Raises:
        LocalError: no owner is there, a name is another owner's, or the successor is another owner's.
    """
    present = load_owner(owner)
    if not (successor / OWNER_KEY).exists():
        save_owner(
            successor, Owner(key or SigningKey.generate(), present.master, present.public), passphrase=passphrase
        )
        if salt := load_salt(owner):
            write_all(successor, {OWNER_SALT: private(salt.encode())})
    heir = load_owner(successor)
    if heir.public != present.public or heir.key.public == present.key.public:
        raise LocalError(f"{successor}: not a successor of {owner}")
    validity = Validity.lasting(_now(unix_s), days * DAY_S)
    for given in [present.succeed(heir.key.public, each, validity) for each in names]:
        save_delegation(successor / SUCCESSION, given, force=True)
        about = given.name.to_text()
        note_once(owner, Action.ACCEPTED, "succession", who=given.node.to_text(), about=about, unix_s=_now(unix_s))
    return load_owner(successor)


def make_node_keys(
    directory: Path,
    role: Role,
    label: str,
    *,
    more: Mapping[str, str | int] | None = None,
    key: SigningKey | None = None,
    passphrase: bytes | None = None,
    force: bool = False,
) -> NodeKeys:
    """Make a node's keys and its request for a membership, and keep them in ``directory``.

    ``key`` and ``passphrase`` as for ``make_domain``.

    Raises:
        LocalError: the metadata are invalid, the library lacks the KEM, or a node exists there already.
    """
    keys = NodeKeys.generate(role, label, more, key)
    save_node_keys(directory, keys, node_metadata(role, label, more), passphrase=passphrase, force=force)
    return keys


def make_node(
    directory: Path,
    role: Role,
    label: str,
    domain: Path,
    *,
    more: Mapping[str, str | int] | None = None,
    days: float = MEMBER_DAYS,
    force: bool = False,
    unix_s: float | None = None,
) -> Identity:
    """Make a node and admit it to a domain whose directory is accessible here.

    Raises:
        LocalError: as ``make_node_keys`` and ``admit_node``.
    """
    make_node_keys(directory, role, label, more=more, force=force)
    return admit_node(domain, directory, days=days, force=force, unix_s=unix_s)


def admit(domain: Path, request: bytes, *, days: float = MEMBER_DAYS, unix_s: float | None = None) -> Membership:
    """Return the membership that a request asks for; it ends with the root at the latest.

    Raises:
        StatementError: the request is not valid.
        LocalError: no domain is there, or its ledger cannot be written.
    """
    authority, now = load_domain(domain), _now(unix_s)
    member = authority.issue(request, _within(authority.root, now, days))
    _issued(domain, member, now)
    return member


def issue_door(
    domain: Path, request: bytes, hosts: Sequence[str], *, days: float = MEMBER_DAYS, unix_s: float | None = None
) -> bytes:
    """Return the TLS certificate, DER, of the door of a node that made a request; as ``issue_door_certificate``."""
    authority = load_domain(domain)
    return issue_door_certificate(authority, request, hosts, _within(authority.root, _now(unix_s), days))


def admit_node(
    domain: Path, node: Path, *, days: float = MEMBER_DAYS, force: bool = False, unix_s: float | None = None
) -> Identity:
    """Admit a node whose directory is accessible here, and complete that directory.

    Raises:
        LocalError: no domain or no keys are there, the node already belongs to one, or the ledger cannot be written.
    """
    authority, now = load_domain(domain), _now(unix_s)
    if not force:
        refuse_existing(node / NODE_CERTIFICATE)  # before the first signature
    identity = load_node_keys(node).join(authority, _within(authority.root, now, days))
    _issued(domain, identity.member, now)
    save_identity(node, identity, force=force)
    return identity


def renew(domain: Path, certificate: bytes, *, days: float = MEMBER_DAYS, unix_s: float | None = None) -> Membership:
    """Return a new membership for the same key, role and label; the one that it replaces may have expired.

    Raises:
        StatementError: this domain did not issue the membership.
        LocalError: no domain is there, or its ledger cannot be written.
    """
    authority, now = load_domain(domain), _now(unix_s)
    stranger = Unverified.from_wire(certificate)
    present = stranger.verify(authority.root, min(now, stranger.validity.not_after_unix_s))
    member = authority.renew(present, _within(authority.root, now, days))
    _issued(domain, member, now)
    return member


def renew_node(
    domain: Path,
    node: Path,
    *,
    days: float = MEMBER_DAYS,
    before_days: float | None = None,
    unix_s: float | None = None,
) -> Membership | None:
    """Renew the membership of a node whose directory is accessible here; a running node reloads it.

    Only the node descriptor needs the node's key: the descriptor does not change if the key is under a passphrase or in
    a token.

    Args:
        before_days: renew only if it ends within this number of days; None: in any case.

    Returns:
        The new membership, or None if the present one lasts longer.

    Raises:
        StatementError: this domain did not issue the membership.
        LocalError: as ``renew``.
    """
    now, path = _now(unix_s), node / NODE_CERTIFICATE
    wire = read_public(path)
    if before_days is not None:
        ends_unix_s = parsed(path, Unverified.from_wire, wire).validity.not_after_unix_s
        if ends_unix_s - now > before_days * DAY_S:
            return None
    member = parsed(path, lambda data: renew(domain, data, days=days, unix_s=now), wire)
    root = load_root(domain / ROOT_CERTIFICATE)
    if all(each is Storage.PLAIN for each in storage(node).values()):
        save_identity(node, load_node_keys(node).admitted(member, root), force=True)
    else:
        save_membership(node, member, root)
    return member


def install_membership(
    node: Path, certificate: bytes, root: Root, *, force: bool = False, unix_s: float | None = None
) -> Identity:
    """Complete a node's directory with a membership that was issued elsewhere.

    Raises:
        StatementError: it is not valid under this root.
        LocalError: it is another node's, or the node has one already.
    """
    member = Membership.from_wire(certificate, root, _now(unix_s))
    identity = load_node_keys(node).admitted(member, root)
    save_identity(node, identity, force=force)
    return identity


def delegate(
    owner: Path,
    recipient: Path | Recipient,
    metadata: Metadata,
    rights: Collection[Right],
    epochs: Iterable[int] = (0,),
    *,
    days: float = DELEGATION_DAYS,
    may_delegate: bool = False,
    unix_s: float | None = None,
) -> Delegation:
    """Let a node act on a name, and grant it the secrets of ``epochs``.

    Args:
        recipient: the node, or the file of its descriptor.

    Raises:
        LocalError: no owner or descriptor is there, or rights or epochs are out of bounds.
    """
    face = load_card(recipient) if isinstance(recipient, Path) else recipient
    validity = Validity.lasting(_now(unix_s), days * DAY_S)
    given = load_owner(owner).delegate(face, metadata, rights, epochs, validity, may_delegate=may_delegate)
    who, about = given.node.to_text(), given.name.to_text()
    note_once(owner, Action.ACCEPTED, "delegation", who=who, about=about, unix_s=_now(unix_s))
    return given


def valid_delegation(
    delegations: Iterable[Delegation], node: Recipient, name: Name, unix_s: float
) -> Delegation | None:
    """Return the node's delegation of a name, if it is valid at that time. Revocations are checked elsewhere."""
    for delegation in delegations:
        if delegation.name == name:
            try:
                chain = Chain.traverse(delegation.chain, delegation.subject, node.subject, AdCertCache(CHAIN_MAX))
                for right in delegation.rights:
                    chain.check(right, unix_s)
            except StatementError:
                return None  # expired, or of an earlier node here: a new one replaces it
            return delegation
    return None


def widened(
    owner: Path,
    node: Recipient,
    metadata: Metadata,
    rights: Collection[Right],
    held: Delegation | None,
    epochs: Iterable[int] = (),
    *,
    days: float,
) -> Delegation:
    """Return a delegation of these rights and epochs, and of those that the node holds; by default epoch 0.

    Raises:
        LocalError: as ``delegate``.
    """
    before, known = (frozenset[Right](), ()) if held is None else (held.rights, held.grants.keys())
    return delegate(owner, node, metadata, before.union(rights), {*known, *epochs} or (0,), days=days)


def install_delegation(node: Path, delegation: Delegation, *, force: bool = False, unix_s: float | None = None) -> Path:
    """Verify that a delegation is valid and opens, and write it into the node's directory; return the file.

    Raises:
        StatementError: it is for another node, or not valid.
        LocalError: a delegation of the name exists already.
    """
    now = _now(unix_s)
    identity = load_identity(node, now)
    delegation.verify(identity, now)
    delegation.open(identity)
    return save_delegation(node / DELEGATIONS, delegation, force=force)


def delegate_route(node: Path, switch: Name, *, days: float, unix_s: float | None = None) -> bytes:
    """Return the RtCert by which a node lets a switch attract its traffic. Raises ``LocalError``: no node is there."""
    now = _now(unix_s)
    return RtCert.make(load_identity(node, now), switch, Validity.lasting(now, days * DAY_S))


def _issued(domain: Path, member: Membership, unix_s: float) -> None:
    """Record a membership in the ledger, which must precede its use, and in the audit log."""
    append_issued(domain, member, unix_s)
    who, about = member.name.to_text(), member.fingerprint.hex()
    note_once(domain, Action.ACCEPTED, f"membership {member.role.value}", who=who, about=about, unix_s=unix_s)


def _now(unix_s: float | None) -> float:
    return time.time() if unix_s is None else unix_s


def _within(root: Root, unix_s: float, days: float) -> Validity:
    wanted = Validity.lasting(unix_s, days * DAY_S)
    end = min(wanted.not_after_unix_s, root.validity.not_after_unix_s)
    if end <= wanted.not_before_unix_s:
        raise LocalError("the root of the domain has run out")
    return Validity(wanted.not_before_unix_s, end)
