"""Far nodes in this graph: a node of rclpy for each, which owns the endpoint's entities of the names that it has.

I/O through rclpy; called by the proxy's thread. What a node has, and the endpoint has not or another node owns, only
appears: a publisher that sends nothing, a subscription that is never read, a client that never calls. A server is real
or absent, because two servers of one name would both be asked.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from typing import Final, TypeAlias

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.ros2.qos import filled
from proxy.endpoints.ros2.session import ContextNode, Node, Opened

log = logging.getLogger(__name__)

Place: TypeAlias = tuple[Role, str]  # role and name, which may have entities of several nodes

_OWNED: Final = (Role.PUBLISHES, Role.SUBSCRIBES, Role.SERVES)
_APPEAR: Final = (Role.PUBLISHES, Role.SUBSCRIBES, Role.CALLS)


class FarNodes:
    """The far nodes of one graph."""

    def __init__(self, session: ContextNode) -> None:
        self._session = session
        self._nodes: dict[str, Node] = {}
        self._ends: dict[Place, list[GraphEntity]] = {}  # those of the owner first
        self._shown: dict[Place, dict[GraphEntity, Opened]] = {}

    def home(self, role: Role, name: str) -> Node:
        """Return the node that owns the endpoint's entity of a name: the first far one that has it, or our own."""
        ends = self._ends.get((role, name)) if role in _OWNED else None
        return self._nodes[ends[0].node] if ends else self._session.node

    def replace_nodes(self, nodes: Mapping[str, Graph], here: Collection[str]) -> set[Place]:
        """Replace the nodes; return the places to ``show``. Nodes that are gone stay until ``remove_others``.

        Args:
            here: names of the nodes of this machine's graph; a far one of an equal name does not appear.
        """
        before = self._ends
        for name in sorted(nodes.keys() - self._nodes.keys()):
            if name in here:
                log.warning("a far node does not appear: this graph has a node of its name")
                continue
            try:
                self._nodes[name] = self._session.create_node(name)
            except LocalError as error:
                log.warning("a far node does not appear reason=%s", error)
        self._ends = {}
        for name in sorted(nodes.keys() & self._nodes.keys()):
            for end in sorted(nodes[name], key=repr):
                self._ends.setdefault((end.role, end.name), []).append(end)
        return {each for each in before.keys() | self._ends.keys() if before.get(each) != self._ends.get(each)}

    def show(self, place: Place, *, is_real: bool) -> None:
        """Have appear what the nodes have at a place.

        Args:
            is_real: the endpoint has an entity there, so that its owner needs no other one.
        """
        ends = self._ends.get(place, []) if place[0] in _APPEAR else []
        wanted, shown = ends[1:] if is_real and place[0] in _OWNED else ends, self._shown.pop(place, {})
        for end in shown.keys() - set(wanted):
            self._session.destroy(shown.pop(end))
        for end in wanted:
            if end not in shown:
                try:
                    home, qos = self._nodes[end.node], filled(end.qos)
                    shown[end] = self._session.create(end.role, home, end.name, end.type_name, qos)
                except LocalError as error:
                    log.info("an entity of a far node does not appear reason=%s", error)
        if shown:
            self._shown[place] = shown

    def remove_others(self, nodes: Collection[str]) -> None:
        """Remove the nodes that are not among these."""
        for name in self._nodes.keys() - set(nodes):
            self._session.destroy_node(name, self._nodes.pop(name))
