"""Graph cache of the endpoint: changes are queried at once, the rest in rotation.

I/O; queries rclpy's graph cache, from the wait-set thread. A refresh compares names, types and counts, which is cheap.
The costly queries (node and QoS) follow for topics whose counts changed, and for a quarter of the others. So an entity
that replaced another one between two refreshes is detected four refreshes later.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final

from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.ros2.qos import from_profile
from proxy.endpoints.ros2.session import ContextNode, TopicEnd

_TURNS: Final = 4
_UNKNOWN: Final = "_NODE_NAME_UNKNOWN_"  # its discovery is incomplete


class GraphCache:
    """The last known graph, without the endpoint's own nodes."""

    def __init__(self, session: ContextNode) -> None:
        self._node = session.node
        self._own = session.own
        self._past = frozenset(session.own)  # those at the beginning of a refresh: some may leave during it
        self._missing = session.rcl.NodeNameNonExistentError
        self._turn = 0
        self._counts: dict[str, tuple[list[str], int, int]] = {}
        self._by_topic: dict[str, Graph] = {}
        self._unsure: set[str] = set()
        counts = ("get_count_services", "get_count_clients")  # Iron and later
        self._count_services: list[Callable[[str], int]] = [
            getattr(session.node.handle, count) for count in counts if hasattr(session.node.handle, count)
        ]
        self._services: Sequence[object] = ()
        self._by_node: dict[tuple[str, str], Graph] = {}
        self.graph: Graph = frozenset()

    def refresh(self) -> bool:
        """Refresh the cache; return whether ``graph`` changed."""
        self._turn = (self._turn + 1) % _TURNS
        self._past = frozenset(self._own)
        changed = self._look_at_topics()
        changed |= self._look_at_nodes()
        if changed:
            self.graph = frozenset().union(*self._by_topic.values(), *self._by_node.values())
        return changed

    def ends_of(self, topic: str) -> Graph:
        """Return the publishers and subscriptions of a topic."""
        return self._by_topic.get(topic, frozenset())

    def query_topic(self, topic: str) -> Graph:
        """Query one topic now, including entities of nodes that are not known yet."""
        return frozenset(self._asked(topic))

    def _look_at_topics(self) -> bool:
        handle = self._node.handle
        found = {
            name: (types, handle.get_count_publishers(name), handle.get_count_subscribers(name))
            for name, types in self._node.get_topic_names_and_types(no_demangle=False)
        }
        before = self._by_topic
        self._by_topic = {name: before[name] for name in found if name in before}
        for name, counts in found.items():
            if counts != self._counts.get(name) or name in self._unsure or hash(name) % _TURNS == self._turn:
                self._by_topic[name] = self._ends(name)
        self._counts = found
        self._unsure &= found.keys()
        return self._by_topic != before

    def _ends(self, topic: str) -> Graph:
        ends = list(self._asked(topic))
        known = frozenset(end for end in ends if end.node)
        if len(known) == len(ends):
            self._unsure.discard(topic)
        else:
            self._unsure.add(topic)
        return known

    def _asked(self, topic: str) -> Iterator[GraphEntity]:
        yield from self._reported(Role.PUBLISHES, topic, self._node.get_publishers_info_by_topic(topic))
        yield from self._reported(Role.SUBSCRIBES, topic, self._node.get_subscriptions_info_by_topic(topic))

    def _reported(self, role: Role, topic: str, ends: list[TopicEnd]) -> Iterator[GraphEntity]:
        for end in ends:
            if self._is_own((end.node_name, end.node_namespace)):
                continue
            node = "" if end.node_name == _UNKNOWN else _full_name(end.node_name, end.node_namespace)
            digest = str(getattr(end, "topic_type_hash", ""))  # Iron and later
            digest = digest if digest.startswith("RIHS01_") else ""
            gid = bytes(end.endpoint_gid).hex()
            yield GraphEntity(role, topic, end.topic_type, node, gid, hash=digest, qos=from_profile(end.qos_profile))

    def _look_at_nodes(self) -> bool:
        services = [
            (name, types, *(count(name) for count in self._count_services))
            for name, types in sorted(self._node.get_service_names_and_types())
        ]
        found = self._node.get_node_names_and_namespaces()
        nodes = {node for node in found if node[0] != _UNKNOWN and not self._is_own(node)}
        before = self._by_node
        self._by_node = {node: before[node] for node in nodes if node in before}
        for node in nodes:
            if services != self._services or node not in before or hash(node) % _TURNS == self._turn:
                self._by_node[node] = self._ends_of_node(*node)
        self._services = services
        return self._by_node != before

    def _is_own(self, node: tuple[str, str]) -> bool:
        return node in self._own or node in self._past

    def _ends_of_node(self, name: str, space: str) -> Graph:
        try:
            served = self._node.get_service_names_and_types_by_node(name, space)
            called = self._node.get_client_names_and_types_by_node(name, space)
        except self._missing:  # the entity left at this moment
            return frozenset()
        node = _full_name(name, space)
        return frozenset(
            GraphEntity(role, service, type_name, node, node)
            for role, found in ((Role.SERVES, served), (Role.CALLS, called))
            for service, types in found
            for type_name in types
        )


def _full_name(name: str, space: str) -> str:
    return f"{space.rstrip('/')}/{name}"
