"""Exchange between the members of a domain: their descriptors, and mail from one to another.

I/O: interface, and the choice of recipients by label or group. The exchange authenticates the sender of each mail. The
content needs no trust in it: a delegation is signed by the owner, and its secrets are sealed to the recipient.
One exchange is a folder that the nodes share: for one machine, or for a lab with a common file system. The writers of
the folder are trusted with the sender's name, and with nothing else::

    nodes/NAME.card            descriptor of each member
    mail/RECIPIENT/ID.mail     CBOR: from, kind, data; in the order of their identifiers
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Final, Protocol

from gdp.config.yaml_source import read_yaml
from gdp.crypto.certificates import Role, Root
from gdp.crypto.schema import FLAG, NAME, OCTETS, FieldSet, Keyed, text
from gdp.errors import LocalError, StatementError
from gdp.names import Name
from gdp.stores.files import private, public, read_public, write_all
from gdp.stores.keyring import load_card
from gdp.trust.delegation import DELEGATION_MAX_BYTES
from gdp.trust.node_descriptor import NodeDescriptor

log = logging.getLogger(__name__)

_NODES: Final = "nodes"
_MAIL: Final = "mail"


class MailKind(str, Enum):
    """Kind of a mail between the parties of a delegation; QoS and exposure come after the delegation of their name."""

    DELEGATION = "share"
    REVOCATION = "share-revocation"
    QOS = "share-qos"
    EXPOSURE = "share-exposure"


@dataclass(frozen=True, slots=True, kw_only=True)
class Mail(FieldSet):
    """One received mail.

    Args:
        sender: label of the authenticated member.
        kind: value of a ``MailKind``.
    """

    MAX_BYTES = DELEGATION_MAX_BYTES + 1_024
    sender: Annotated[str, Keyed("from", text(4_096))]
    kind: Annotated[str, Keyed("kind", text(4_096))]
    data: Annotated[bytes, Keyed("data", OCTETS)]


@dataclass(frozen=True, slots=True)
class Exposure(FieldSet):
    """Whether the machine that offered a name exposes it: body of a mail, which is sent where that changes."""

    MAX_BYTES = 256
    name: Annotated[Name, Keyed("name", NAME)]
    is_exposed: Annotated[bool, Keyed("exposed", FLAG)]


class Exchange(Protocol):
    """Directory and mailboxes of one domain, as one member uses them; each call may raise ``GdpError``."""

    def nodes(self) -> Sequence[NodeDescriptor]:
        """Return the descriptors of the present members."""

    def send(self, to: Name, kind: str, data: bytes) -> None:
        """Leave a mail for a member; it is kept until the member receives it."""

    def receive_mail(self) -> Iterator[Mail]:
        """Yield the waiting mails of a ``MailKind``; each is removed when the next one is asked for."""


def proxies_of(exchange: Exchange, root: Root, unix_s: float) -> dict[str, NodeDescriptor]:
    """Return the proxies of a domain by label; a descriptor that the root does not confirm is left out."""
    found = dict[str, NodeDescriptor]()
    for each in exchange.nodes():
        try:
            member = each.member_of(root, unix_s)
        except StatementError:
            continue
        if member.role is Role.PROXY:
            found[member.label] = each
    return found


def load_groups(path: Path) -> dict[str, tuple[str, ...]]:
    """Read ``groups.yaml``: group to labels; without the file there are none.

    Raises:
        ConfigError: the file is not such a mapping.
    """
    if not path.exists():
        return {}
    source = read_yaml(path)
    if not isinstance(source.data, dict):
        raise source.error((), "expected a mapping of groups, such as lab: [server, laptop]")
    groups = dict[str, tuple[str, ...]]()
    for group, labels in source.data.items():
        if not isinstance(labels, list) or not all(isinstance(label, str) for label in labels):
            raise source.error((group,), "expected a list of labels of nodes")
        groups[group] = tuple(str(label) for label in labels)
    return groups


def resolve_recipients(
    wanted: Iterable[str], nodes: Mapping[str, NodeDescriptor], groups: Mapping[str, Sequence[str]]
) -> dict[str, NodeDescriptor]:
    """Return nodes by label for labels and groups; members of a group that have not joined are left out.

    Raises:
        LocalError: neither a node nor a group of that name exists.
    """
    found = dict[str, NodeDescriptor]()
    for each in wanted:
        if each in nodes:
            found[each] = nodes[each]
        elif each in groups:
            found |= {label: nodes[label] for label in groups[each] if label in nodes}
        else:
            known = ", ".join([*sorted(nodes), *sorted(groups)]) or "none"
            raise LocalError(f"{each!r}: no such node or group in the domain; there are: {known}")
    return found


class FolderExchange:
    """Exchange of one member through a shared folder.

    Args:
        folder: made if it is missing.
        own: descriptor of this member, which the folder then shows to the others.

    Raises:
        LocalError: the folder cannot be written.
    """

    def __init__(self, folder: Path, own: NodeDescriptor) -> None:
        self._folder = folder
        self._own = own
        write_all(folder / _NODES, {f"{own.name.to_text()}.card": public(own.wire)}, force=True)

    def nodes(self) -> Sequence[NodeDescriptor]:
        """Return the descriptors in the folder. Raises ``LocalError``: a descriptor is invalid."""
        return [load_card(path) for path in sorted((self._folder / _NODES).glob("*.card"))]

    def send(self, to: Name, kind: str, data: bytes) -> None:
        """Write a mail for a member. Raises ``LocalError``: the folder cannot be written."""
        name = f"{time.time_ns():020d}-{secrets.token_hex(4)}.mail"
        wire = Mail(sender=self._own.label, kind=kind, data=data).to_cbor()
        write_all(self._folder / _MAIL / to.to_text(), {name: private(wire)})

    def receive_mail(self) -> Iterator[Mail]:
        """Yield the waiting mails; each is removed when the next one is asked for, a malformed one at once."""
        for path in sorted((self._folder / _MAIL / self._own.name.to_text()).glob("*.mail")):
            try:
                mail = Mail.from_cbor(read_public(path))
            except StatementError as error:
                log.warning("mail removed path=%s reason=%s", path, error)
                path.unlink()
                continue
            yield mail
            path.unlink()
