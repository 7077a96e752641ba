"""Who is there: the readers and writers that peers announced, and whose node each is.

Place: pure; discovery is fed in. The ends of a ROS participant are shown only once it has said which node they belong
to: for a moment the ends of another proxy would look like those of a robot's node.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from proxy.endpoints.dds.naming import Named
from proxy.endpoints.dds.node_info import NodeInfo
from proxy.endpoints.endpoint import Graph, GraphEntity, Role
from proxy.serial.channel import Qos

__all__ = ["GraphCache", "Peer"]

_PREFIX: Final = 12  # bytes of a GID that name its participant


@dataclass(frozen=True, slots=True)
class Peer:
    """One reader or writer of somebody else.

    Args:
        named: what it is in ROS; None for the reply half of a client or server.
        identity: of the client or server that it is a half of, empty where it is none.
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
        """Learn of a reader or writer, by its instance handle."""
        self.lost(handle)
        self._peers[handle] = peer
        if peer.named is not None:
            self._named.setdefault(peer.named[:2], {})[handle] = peer
        self._graph = None

    def lost(self, handle: int) -> None:
        """Learn that it is gone."""
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
        """Learn of a participant that is ROS."""
        self._participants[handle] = gid[:_PREFIX]
        self._graph = None

    def left(self, handle: int) -> None:
        """Learn that it is gone."""
        prefix = self._participants.pop(handle, None)
        if prefix is not None:
            self._nodes.pop(prefix, None)
            self._graph = None

    def told(self, info: NodeInfo) -> None:
        """Learn whose the ends of a participant are."""
        self._nodes[info.participant[:_PREFIX]] = dict(info.nodes)
        self._graph = None

    def peer(self, handle: int) -> Peer | None:
        """Return the reader or writer with this instance handle."""
        return self._peers.get(handle)

    def graph(self) -> Graph:
        """Return who is there."""
        if self._graph is None:
            ros = set(self._participants.values())
            self._graph = frozenset(self._ends(ros))
        return self._graph

    def peers(self, role: Role, name: str, type_name: str = "") -> Iterator[Peer]:
        """Yield those that do this with a name, whether they have told their node or not.

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
                yield GraphEntity(role, name, type_name, node, peer.gid.hex(), peer.hash, qos)
