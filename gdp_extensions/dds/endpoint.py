"""Endpoint ``dds``: a ROS 2 graph through Cyclone DDS, without a ROS installation.

I/O, through its parts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import count
from typing import Final, TypeVar

from gdp.errors import LocalError
from gdp.ros_names import ACTION_INFIX
from gdp_extensions.dds.discovery import Discovery
from gdp_extensions.dds.graph_cache import GraphCache
from gdp_extensions.dds.node import EntityContext, Node
from gdp_extensions.dds.services import Client, Server
from gdp_extensions.dds.topics import Publication, Subscription
from proxy.endpoints.core.endpoint import Event, Graph, GraphChanged, Role
from proxy.serial.channel import Channel, Qos, RosVersion, Service
from proxy.serial.standard_types import standard_channel, type_hash

_Open = Subscription | Publication | Server | Client
_T = TypeVar("_T", Subscription, Publication, Server, Client)


class DdsEndpoint:
    """One node in a DDS domain, as peers see it.

    CYCLONEDDS_URI configures the network, as for every program with Cyclone DDS.

    Raises:
        LocalError: the domain cannot be joined.
    """

    ros: Final[RosVersion] = 2
    is_live: Final = True
    dropped: Final = 0  # messages wait in the middleware, which drops them by its QoS

    def __init__(self, domain: int, node: str) -> None:
        self.label = f"dds domain {domain}"
        self._events = deque[Event]([GraphChanged()])
        self._is_taking = False
        self._open: dict[int, _Open] = {}
        self._numbers = count(1)
        self._survey = GraphCache()
        self._shown: Graph = frozenset()
        self._node = Node(domain, node)
        self._discovery = Discovery(self._node, self._survey, self._follow)
        self._node.watch.wake()

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll_events`` has events."""
        return self._node.watch.fileno()

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events, in order."""
        self._is_taking = True
        self._node.watch.catch_up()
        self._is_taking = False
        events = [*self._events]
        self._events.clear()
        return [each for each in events if isinstance(each, GraphChanged) or each.handle in self._open]

    def graph(self) -> Graph:
        """Return the graph as of the last ``poll_events``."""
        return self._survey.graph()

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return a topic of a standard type, or one of the hidden topics of a local action, as bytes."""
        known = standard_channel(topic, type_name)
        if known is not None:
            return known
        for peer in self._survey.peers(Role.PUBLISHES, topic, type_name):
            if ACTION_INFIX in topic:
                return Channel(topic, type_name, 2, hash=peer.hash)
        raise LocalError(
            f"{type_name} is not known here: endpoint dds knows the types of ROS 2's own packages;"
            " use endpoint ros2, or publish it from a machine that has its package"
        )

    def service(self, name: str, type_name: str) -> Service:
        """Return a service that a local node serves; its messages are opaque bytes."""
        for peer in self._survey.peers(Role.SERVES, name, type_name):
            request, response = (Channel(name, f"{type_name}_{part}", 2) for part in ("Request", "Response"))
            return Service(name, type_name, peer.hash, request, response)
        raise LocalError(f"{type_name} is not known here: endpoint dds knows a service while a local node serves it")

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Subscribe to a topic of any type."""
        handle = next(self._numbers)
        return self._keep(handle, Subscription(self._context(handle), topic, type_name, qos))

    def advertise(self, channel: Channel) -> int:
        """Create a publisher of a topic.

        Raises:
            LocalError: it is not ROS 2's, or local nodes have another type of that name.
        """
        if channel.ros != 2:
            raise LocalError(f"{channel.topic}: messages of ROS {channel.ros} cannot be published in DDS")
        handle = next(self._numbers)
        return self._keep(handle, Publication(self._context(handle), channel, _hash_of(channel)))

    def publish(self, handle: int, raw: bytes) -> None:
        """Publish one message."""
        self._find(handle, Publication).publish(raw)

    def subscribers(self, handle: int) -> int:
        """Return the present number of local subscriptions of a publisher."""
        return self._find(handle, Publication).subscribers

    def serve(self, service: Service) -> int:
        """Create a server for clients on Cyclone DDS; clients on other vendors raise ``EndpointError`` events."""
        if service.ros != 2:
            raise LocalError(f"{service.name}: a service of ROS {service.ros} cannot be served in DDS")
        handle, hashed = next(self._numbers), service.hash if service.hash.startswith("RIHS01_") else ""
        return self._keep(handle, Server(self._context(handle), service, hashed, lambda: next(self._numbers)))

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a request."""
        self._find(handle, Server).answer(ticket, raw)

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Answer {success: false, message: reason} where the response has these fields; ROS 2 has no other way."""
        self._find(handle, Server).refuse(ticket, reason)

    def create_client(self, name: str, type_name: str) -> int:
        """Create a client for servers on Cyclone DDS; servers on other vendors raise ``EndpointError`` events."""
        handle = next(self._numbers)
        hashed = next((peer.hash for peer in self._survey.peers(Role.SERVES, name, type_name)), "")
        return self._keep(handle, Client(self._context(handle), name, type_name, hashed))

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Send a request."""
        self._find(handle, Client).call(call, raw)

    def drop(self, handle: int, call: int) -> None:
        """Forget a call."""
        self._find(handle, Client).drop(call)

    def close(self, handle: int) -> None:
        """Close a subscription, publisher, server or client."""
        self._open.pop(handle).close()

    def shut_down(self) -> None:
        """Leave the graph and free everything."""
        self._discovery.close()
        self._open.clear()
        self._node.leave()

    def _context(self, handle: int) -> EntityContext:
        return EntityContext(self._node, self._survey, handle, self._tell)

    def _keep(self, handle: int, opened: _Open) -> int:
        self._open[handle] = opened
        return handle

    def _find(self, handle: int, kind: type[_T]) -> _T:
        opened = self._open.get(handle)
        if not isinstance(opened, kind):
            raise LocalError(f"handle {handle} is no {kind.__name__.lower()}")
        return opened

    def _tell(self, event: Event) -> None:
        if not self._events and not self._is_taking:
            self._node.watch.wake()
        self._events.append(event)

    def _follow(self) -> None:
        """Pass changes of the graph on to all entities."""
        for opened in self._open.values():
            if not isinstance(opened, Publication):
                opened.follow()
        graph = self._survey.graph()
        if graph != self._shown:
            self._shown = graph
            self._tell(GraphChanged())


def _hash_of(channel: Channel) -> str:
    """Return the ROS 2 type hash of a channel: its own, or that of its definition; empty where it cannot be derived."""
    if channel.hash.startswith("RIHS01_"):
        return channel.hash
    if channel.definition_format:
        return type_hash(channel.type_name, channel.definition, channel.definition_format)
    known = standard_channel(channel.topic, channel.type_name)
    return known.hash if known is not None else ""
