"""Exchange between the members of a domain: their descriptors, and mail from one to another.

Interface, and the choice of recipients by label or group. The exchange authenticates the sender of each mail. The
content needs no trust in it: a delegation is signed by the owner, and its secrets are sealed to the recipient.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Protocol

from gdp.config.yaml_source import read_yaml
from gdp.crypto.certificates import Role, Root
from gdp.crypto.schema import FLAG, NAME, OCTETS, FieldSet, Keyed, text
from gdp.errors import LocalError, StatementError
from gdp.names import Name
from gdp.trust.delegation import DELEGATION_MAX_BYTES
from gdp.trust.node_descriptor import NodeDescriptor


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
