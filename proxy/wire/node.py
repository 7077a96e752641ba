"""Nodes for other machines: their entities, under the names that all sides know, and how their state is kept equal.

Sans-I/O. Everything travels sealed, on the name of a rule of kind ``node``; invalid bytes raise ``RemoteError``. The
server's description is the digest of all its nodes. Each change goes to all clients; a client whose digest differs asks
for the whole state. A client's description is what it wants of the nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Annotated, Final, NamedTuple, TypeAlias, TypeVar

from gdp.crypto.cbor import decode, encode
from gdp.crypto.schema import OCTETS, FieldSet, Form, Keyed, literal, many, mapped, octets, one_of, or_empty, row
from gdp.ros_names import Interface
from proxy.endpoints.core.endpoint import Role
from proxy.serial.channel import QOS, TEXT, Qos

NODES_MAX: Final = 1_000  # of one rule; one decode has at most 2,048 items, and each node is one
ENTITIES_MAX: Final = 1_024  # of one node, each alike
WANTED_MAX: Final = 2_000  # names that one machine uses, each one item, too
_NODE_MAX_BYTES: Final = 1 << 20
_DIGEST_BYTES: Final = 16

_T = TypeVar("_T")
Wanted: TypeAlias = tuple[Interface, str]  # kind and name of what crosses


class NodeEntity(NamedTuple):
    """Publisher, subscription, server or client of a node; ``qos`` of topics only."""

    role: Role
    name: str
    type_name: str
    qos: Qos | None = None


class NodeEntry(NamedTuple):
    """A node with what it has; the parts of its actions are among the topics and services."""

    name: str
    entities: tuple[NodeEntity, ...]


def _apart(form: Form[_T]) -> Form[_T]:
    """Return the form of what travels encoded in itself, so that the whole is decoded in pieces."""
    return mapped(
        OCTETS, lambda wire: form.read(decode(wire, _NODE_MAX_BYTES)), lambda value: encode(form.write(value))
    )


_ENTITY: Final = _apart(row(NodeEntity, one_of(Role), TEXT, TEXT, or_empty(QOS, None)))
_ENTRY: Final = _apart(row(NodeEntry, TEXT, many(_ENTITY, ENTITIES_MAX)))
_WANTED: Final[Form[Wanted]] = _apart(row(lambda *each: each, literal("topic", "service", "action"), TEXT))
_DIGEST: Final = octets(_DIGEST_BYTES)


@dataclass(frozen=True, slots=True)
class NodesChange(FieldSet):
    """Nodes that are new or have changed, and those that are gone; ``before``: digest of the state that it changes."""

    MAX_BYTES = 8 << 20
    before: Annotated[bytes, Keyed("b", or_empty(_DIGEST, b""))]  # empty: the nodes are the whole state
    nodes: Annotated[tuple[NodeEntry, ...], Keyed("n", many(_ENTRY, NODES_MAX))]
    gone: Annotated[tuple[str, ...], Keyed("g", many(TEXT, NODES_MAX))] = ()


@dataclass(frozen=True, slots=True)
class NodesWanted(FieldSet):
    """What a client uses of the nodes now."""

    MAX_BYTES = 2 << 20
    names: Annotated[tuple[Wanted, ...], Keyed("w", many(_WANTED, WANTED_MAX))] = ()


class NodeSet:
    """State of the nodes of one server.

    Attributes:
        nodes: the entities of each, by name.
        digest: over all of them; empty before the first state is known.
    """

    def __init__(self) -> None:
        self.nodes: Mapping[str, tuple[NodeEntity, ...]] = {}
        self.digest = b""

    def replace(self, nodes: Mapping[str, tuple[NodeEntity, ...]]) -> NodesChange:
        """Replace the state; return the change for who had the one before."""
        before, known = self.digest, self.nodes
        self.nodes = dict(sorted(nodes.items()))
        entries = [NodeEntry(*each) for each in self.nodes.items()]
        self.digest = sha256(encode(NodesChange(b"", tuple(entries)).to_fields())).digest()[:_DIGEST_BYTES]
        changed = tuple(each for each in entries if known.get(each.name) != each.entities)
        return NodesChange(before, changed, tuple(sorted(known.keys() - self.nodes.keys())))

    def whole(self) -> NodesChange:
        """Return the whole state."""
        return NodesChange(b"", tuple(NodeEntry(*each) for each in self.nodes.items()))

    def apply(self, change: NodesChange) -> None:
        """Apply a change, unless it is one of another state."""
        if change.before in (b"", self.digest):
            kept = self.nodes if change.before else {}
            left = {name: entities for name, entities in kept.items() if name not in change.gone}
            self.replace({**left, **dict(change.nodes)})
