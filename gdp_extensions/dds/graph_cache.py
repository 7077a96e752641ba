"""Graph cache: the readers and writers that peers announced, and their nodes.

Sans-I/O; discovery supplies the input. The entities of a ROS participant are shown only after it has announced their
nodes. Until then the entities of another proxy would look like those of a robot's node.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from gdp_extensions.dds.naming import Named
from gdp_extensions.dds.node_info import NodeInfo
from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role
from proxy.serial.channel import Qos

_PREFIX: Final = 12  # bytes of a GID that identify its participant


@dataclass(frozen=True, slots=True)
class Peer:
    """One reader or writer of another participant.

    Args:
        named: its ROS name, type and role; None for the reply half of a client or server.
        identity: of the client or server to which it belongs, empty where there is none.
    """

    gid: bytes
    named: Named | None
    hash: str
    qos: Qos
    identity: bytes


class GraphCache:
    """The graph, as far as it was announced."""

    def __init__(self) -> None:
        self._peers: dict[int, Peer] = {}  # by instance handle
        self._named: dict[tuple[Role, str], dict[int, Peer]] = {}
        self._participants: dict[int, bytes] = {}  # of ROS: instance handle -> prefix
        self._nodes: dict[bytes, dict[bytes, str]] = {}  # prefix -> GID -> node
        self._graph: Graph | None = None

    def found(self, handle: int, peer: Peer) -> None:
        """Add a reader or writer, by its instance handle."""
        self.lost(handle)
        self._peers[handle] = peer
        if peer.named is not None:
            self._named.setdefault(peer.named[:2], {})[handle] = peer
        self._graph = None

    def lost(self, handle: int) -> None:
        """Remove a reader or writer."""
        peer = self._peers.pop(handle, None)
        if peer is None:
            return
        self._graph = None
        if peer.named is not None:
            same = self._named[peer.named[:2]]
            del same[handle]
            if not same:
                del self._named[peer.named[:2]]

    def joined(self, handle: int, gid: bytes) -> None:
        """Add a ROS participant."""
        self._participants[handle] = gid[:_PREFIX]
        self._graph = None

    def left(self, handle: int) -> None:
        """Remove a participant."""
        prefix = self._participants.pop(handle, None)
        if prefix is not None:
            self._nodes.pop(prefix, None)
            self._graph = None

    def receive_node_info(self, info: NodeInfo) -> None:
        """Record the nodes of a participant's entities."""
        self._nodes[info.participant[:_PREFIX]] = dict(info.nodes)
        self._graph = None

    def peer(self, handle: int) -> Peer | None:
        """Return the reader or writer with this instance handle."""
        return self._peers.get(handle)

    def graph(self) -> Graph:
        """Return the present entities."""
        if self._graph is None:
            ros = set(self._participants.values())
            self._graph = frozenset(self._ends(ros))
        return self._graph

    def peers(self, role: Role, name: str, type_name: str = "") -> Iterator[Peer]:
        """Yield the peers of this role under a name, including those without an announced node.

        Args:
            type_name: those of this type only; empty: of any.
        """
        for peer in self._named.get((role, name), {}).values():
            if not type_name or (peer.named is not None and peer.named.type_name == type_name):
                yield peer

    def _ends(self, ros: set[bytes]) -> Iterator[GraphEntity]:
        for peer in self._peers.values():
            node = self._nodes.get(peer.gid[:_PREFIX], {}).get(peer.gid, "")
            if peer.named is not None and (node or peer.gid[:_PREFIX] not in ros):
                role, name, type_name = peer.named
                qos = peer.qos if role in (Role.PUBLISHES, Role.SUBSCRIBES) else None
                yield GraphEntity(role, name, type_name, node, peer.gid.hex(), hash=peer.hash, qos=qos)
