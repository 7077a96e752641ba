"""Keyring: the keys and certificates of a domain, an owner and a node, in one directory each.

I/O, through ``files`` and ``private_keys``. ``*`` marks private files (mode 0600); keys may also be under a passphrase,
or in a token that the file names::

    domain/   root.key*  root.crt  issued.jsonl*                          the ledger: see ``ledger``
    owner/    owner.key*  owner.pub  master.key*
              succession/<name>.delegation*                                of a successor: its right to delegate the
              name
    node/     node.key*  kem.key*  node.json  node.csr                      before it belongs to a domain
              node.crt  root.crt  node.card                                 once it does
              delegations/<name>.delegation*                                one for each name that it may act on

Each ``load_*`` raises ``LocalError`` for a file that is missing, invalid, or private and readable for others; the text
names the file. Each ``save_*`` raises ``LocalError`` if a file exists already and ``force`` is not set, or if the
system refuses.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, TypeVar

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Membership, Role, Root
from gdp.crypto.identity import Identity, NodeKeys, node_metadata
from gdp.crypto.kem import KemPrivateKey
from gdp.crypto.keys import PublicKey
from gdp.crypto.x509_profile import to_pem
from gdp.errors import GdpError, LocalError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.files import (
    NewFile,
    ignore_folder,
    private,
    public,
    read_private,
    read_public,
    refuse_work_tree,
    write_all,
)
from gdp.stores.private_keys import Storage, key_file, read_secret, read_signing_key, secret_file, storage_of
from gdp.trust.delegation import Delegation
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.owner import Owner

ROOT_KEY: Final = "root.key"
ROOT_CERTIFICATE: Final = "root.crt"
OWNER_KEY: Final = "owner.key"
OWNER_PUBLIC: Final = "owner.pub"
OWNER_MASTER: Final = "master.key"
OWNER_SALT: Final = "name.salt"  # unguessable part of the names that this owner shares
NODE_KEY: Final = "node.key"
NODE_KEM: Final = "kem.key"
NODE_METADATA: Final = "node.json"
NODE_CERTIFICATE: Final = "node.crt"
REQUEST: Final = "node.csr"
CARD: Final = "node.card"
DELEGATIONS: Final = "delegations"
SUCCESSION: Final = "succession"
_SECRETS: Final = (OWNER_MASTER, NODE_KEM)
_KEYS: Final = (ROOT_KEY, OWNER_KEY, NODE_KEY, *_SECRETS)
_DELEGATION_SUFFIX: Final = ".delegation"

_T = TypeVar("_T")


def parsed(path: Path, read: Callable[[bytes], _T], data: bytes) -> _T:
    """Return the result of ``read`` on a file's bytes; an error names the file.

    Raises:
        LocalError: the content is not valid.
    """
    try:
        return read(data)
    except GdpError as error:
        raise LocalError(f"{path}: {error}") from error


def load_root(path: Path) -> Root:
    """Read a domain's root certificate, PEM or DER."""
    return parsed(path, Root.from_wire, read_public(path))


def load_public_key(path: Path) -> PublicKey:
    """Read an owner's public key, PEM."""
    return parsed(path, PublicKey.from_pem, read_public(path))


def load_card(path: Path) -> NodeDescriptor:
    """Read a node descriptor (``node.card``)."""
    return parsed(path, NodeDescriptor.from_wire, read_public(path))


def save_domain(
    directory: Path, authority: CertificateAuthority, *, passphrase: bytes | None = None, force: bool = False
) -> None:
    """Write a domain's root key and certificate; the key under a passphrase, if one is given."""
    files = {
        ROOT_KEY: key_file(authority.key, passphrase),
        ROOT_CERTIFICATE: public(authority.root.to_pem()),
    }
    _write_keys(directory, files, force=force)


def load_domain(directory: Path) -> CertificateAuthority:
    """Read a domain with its private key."""
    key = read_signing_key(directory / ROOT_KEY)
    root = load_root(directory / ROOT_CERTIFICATE)
    return parsed(directory, lambda _: CertificateAuthority(key, root), b"")


def save_owner(directory: Path, owner: Owner, *, passphrase: bytes | None = None, force: bool = False) -> None:
    """Write an owner's keys, under a passphrase if one is given."""
    files = {
        OWNER_KEY: key_file(owner.key, passphrase),
        OWNER_MASTER: secret_file(owner.master, passphrase),
        OWNER_PUBLIC: public(owner.public.to_pem()),
    }
    _write_keys(directory, files, force=force)


def load_owner(directory: Path) -> Owner:
    """Read an owner."""
    key = read_signing_key(directory / OWNER_KEY)
    public_path, path = directory / OWNER_PUBLIC, directory / OWNER_MASTER
    founder = load_public_key(public_path) if public_path.exists() else key.public
    if founder == key.public:
        return parsed(path, lambda master: Owner(key, master), read_secret(path))
    links = {each.name: each.chain for each in load_delegations(directory / SUCCESSION)}
    return parsed(path, lambda master: Owner(key, master, founder, links), read_secret(path))


def load_salt(directory: Path) -> str:
    """Return the unguessable part of the names that an owner shares; empty: they have none.

    Raises:
        LocalError: the file is not private, or is not text.
    """
    path = directory / OWNER_SALT
    return parsed(path, lambda wire: wire.decode().strip(), read_private(path)) if path.exists() else ""


def save_node_keys(
    directory: Path, keys: NodeKeys, metadata: Metadata, *, passphrase: bytes | None = None, force: bool = False
) -> None:
    """Write a node's keys, its metadata and its membership request; keys under a passphrase, if one is given.

    Raises:
        LocalError: they exist already, the metadata are of another node, or the system refuses.
    """
    if metadata.digest() != keys.digest:
        raise LocalError("the metadata are not those of this node")
    text = json.dumps(dict(metadata), ensure_ascii=False, indent=2, sort_keys=True) + "\n"
    files = {
        NODE_KEY: key_file(keys.key, passphrase),
        NODE_KEM: secret_file(keys.kem.wire, passphrase),
        NODE_METADATA: public(text.encode()),
        REQUEST: public(keys.request()),
    }
    _write_keys(directory, files, force=force)


def load_node_keys(directory: Path) -> NodeKeys:
    """Read a node's keys, whether it belongs to a domain or not."""
    path = directory / NODE_METADATA
    role, label, digest = parsed(path, _node_metadata, read_public(path))
    key = read_signing_key(directory / NODE_KEY)
    kem = parsed(directory / NODE_KEM, KemPrivateKey.from_wire, read_secret(directory / NODE_KEM))
    return NodeKeys(role, label, digest, key, kem)


def save_identity(directory: Path, identity: Identity, *, force: bool = False) -> None:
    """Add the credentials of a member to a node's keys: certificate, root and node descriptor."""
    files = {
        ROOT_CERTIFICATE: public(identity.root.to_pem()),
        NODE_CERTIFICATE: public(to_pem(identity.membership)),
        CARD: public(NodeDescriptor.make(identity)),
    }
    _write_keys(directory, files, force=force)


def save_membership(directory: Path, member: Membership, root: Root) -> None:
    """Replace a node's membership and root; the node descriptor stays, because only the node's key could renew it."""
    files = {ROOT_CERTIFICATE: public(root.to_pem()), NODE_CERTIFICATE: public(to_pem(member.wire))}
    write_all(directory, files, force=True)


def load_identity(directory: Path, unix_s: float) -> Identity:
    """Read a node that belongs to a domain.

    Args:
        unix_s: wall clock; an expired membership is refused here rather than by every neighbour.
    """
    keys = load_node_keys(directory)
    root = load_root(directory / ROOT_CERTIFICATE)
    path = directory / NODE_CERTIFICATE
    member = parsed(path, lambda wire: Membership.from_wire(wire, root, unix_s), read_public(path))
    return parsed(path, lambda _: keys.admitted(member, root), b"")


def save_delegation(directory: Path, delegation: Delegation, *, force: bool = False) -> Path:
    """Write a delegation under its name's hash; return the file.

    Args:
        directory: a node's ``delegations``, or another directory from which it is copied there.
    """
    file = delegation_file(directory, delegation.name)
    _write_keys(directory, {file.name: private(delegation.to_wire())}, force=force)
    return file


def delegation_file(directory: Path, name: Name) -> Path:
    """Return the file of a name's delegation in a directory of delegations."""
    return directory / f"{name.to_text()}{_DELEGATION_SUFFIX}"


def load_delegation(path: Path) -> Delegation:
    """Read one delegation file."""
    return parsed(path, Delegation.from_wire, read_private(path))


def load_delegations(directory: Path) -> list[Delegation]:
    """Read all delegations of a directory, in the order of their names; none if the directory is missing."""
    return [load_delegation(path) for path in sorted(directory.glob(f"[!.]*{_DELEGATION_SUFFIX}"))]


def storage(directory: Path) -> dict[Path, Storage]:
    """Return by file how each private key of a domain, an owner or a node is guarded.

    Raises:
        LocalError: there is none, or one is readable for others.
    """
    found = {directory / name: storage_of(directory / name) for name in _KEYS if (directory / name).exists()}
    if not found:
        raise LocalError(f"{directory}: no private key of a domain, an owner or a node is here")
    return found


def store_again(directory: Path, passphrase: bytes | None) -> dict[Path, Storage]:
    """Put the private keys of a directory under a passphrase, or remove it; return how each is guarded then.

    Each file is replaced as a whole, so a kill in between leaves each one in its old or its new form. A key in a token
    stays there.

    Raises:
        LocalError: one does not open with the present passphrase (then nothing is written), or the system refuses.
    """
    files: dict[str, NewFile] = {}
    for path, found in storage(directory).items():
        if found is Storage.TOKEN:
            continue
        if path.name in _SECRETS:
            files[path.name] = secret_file(read_secret(path), passphrase)
        else:
            files[path.name] = key_file(read_signing_key(path), passphrase)
    write_all(directory, files, force=True)
    return storage(directory)


def _write_keys(directory: Path, files: Mapping[str, NewFile], *, force: bool) -> None:
    """Write files as ``write_all`` does, into a folder that git ignores."""
    refuse_work_tree(directory)
    write_all(directory, files, force=force)
    ignore_folder(directory)


def _node_metadata(data: bytes) -> tuple[Role, str, bytes]:
    try:
        items = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise LocalError("not JSON") from error
    if not isinstance(items, dict):
        raise LocalError("not a JSON object")
    kind, label = items.pop("kind", None), items.pop("name", None)
    if kind not in [role.value for role in Role] or not isinstance(label, str):
        raise LocalError("'kind' is switch, rib or proxy, and 'name' is a text")
    role = Role(kind)
    return role, label, node_metadata(role, label, items).digest()
