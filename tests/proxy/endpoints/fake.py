"""Fake ROS graph in memory, with an endpoint: for tests without ROS.

Sans-I/O, except for the descriptor that an endpoint must have. Everything happens immediately, in the caller's thread.
As in ROS, a late joiner of a latched topic gets its publishers' last messages, and incompatible QoS does not match.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import (
    CallFailed,
    Event,
    Graph,
    GraphChanged,
    GraphEntity,
    MessageReceived,
    RequestReceived,
    ResponseReceived,
    Role,
    TypeResolved,
)
from proxy.endpoints.core.qos import default, depth_of
from proxy.serial.channel import Channel, Qos, RosVersion, Service

__all__ = ["FakeEndpoint", "FakeGraph", "Publication", "Server"]


@dataclass(slots=True, eq=False)
class Publication:
    """A publisher in the graph."""

    graph: FakeGraph
    end: GraphEntity
    qos: Qos
    kept: deque[bytes]

    def publish(self, raw: bytes) -> None:
        """Deliver a message to all matching subscriptions."""
        if self.qos.durability == "transient_local":
            self.kept.append(raw)
        for subscription in self.graph.subscriptions(self.end.name, self.end.type_name):
            if subscription.end.node != self.end.node and self.graph.match(self.qos, subscription.qos):
                subscription.hear(raw)

    def close(self) -> None:
        """Leave the graph."""
        self.graph.publications.remove(self)
        self.graph.changed()


@dataclass(slots=True, eq=False)
class Subscription:
    """A subscription in the graph."""

    graph: FakeGraph
    end: GraphEntity
    qos: Qos
    hear: Callable[[bytes], None]
    described: Callable[[], None]  # called when the description of the topic's messages may have changed

    def close(self) -> None:
        """Leave the graph."""
        self.graph.readers.remove(self)
        self.graph.changed()


@dataclass(slots=True, eq=False)
class Server:
    """A server in the graph; ``ask`` gets a request and a callback for the response or a reason."""

    graph: FakeGraph
    end: GraphEntity
    ask: Callable[[bytes, Callable[[bytes | str], None]], None]

    def close(self) -> None:
        """Leave the graph."""
        self.graph.servers.remove(self)
        self.graph.changed()


class FakeGraph:
    """One ROS graph.

    Args:
        ros: dialect of its messages.
        channels: message types known to its machine, by type name.
        services: service types known to its machine.

    Attributes:
        now_ns: returns the wall clock of the machine.
    """

    def __init__(
        self, ros: RosVersion, channels: Mapping[str, Channel], services: Mapping[str, Service] | None = None
    ) -> None:
        self.ros: RosVersion = ros
        self.channels = channels
        self.services = dict(services or {})
        self.publications: list[Publication] = []
        self.readers: list[Subscription] = []
        self.servers: list[Server] = []
        self.endpoints: list[FakeEndpoint] = []
        self._keys = count()
        self.now_ns: Callable[[], int] = lambda: 0

    def publish(
        self, node: str, topic: str, type_name: str, qos: Qos | None = None, *, hides_depth: bool = False
    ) -> Publication:
        """Add a node's publisher; ``hides_depth``: the graph does not show its depth, as in DDS."""
        qos = qos or default()
        shown = replace(qos, history="unknown", depth=0) if hides_depth else qos
        end = self._end(Role.PUBLISHES, node, topic, type_name, shown)
        publication = Publication(self, end, qos, deque(maxlen=depth_of(qos)))
        self.publications.append(publication)
        self.changed()
        for subscription in self.subscriptions(topic, type_name):
            subscription.described()
        return publication

    def subscribe(
        self,
        node: str,
        topic: str,
        type_name: str,
        hear: Callable[[bytes], None],
        qos: Qos | None = None,
        described: Callable[[], None] = lambda: None,
    ) -> Subscription:
        """Add a node's subscription."""
        qos = qos or default()
        end = self._end(Role.SUBSCRIBES, node, topic, type_name, qos)
        subscription = Subscription(self, end, qos, hear, described)
        self.readers.append(subscription)
        self.changed()
        for publication in self.publications:
            same = (publication.end.name, publication.end.type_name) == (topic, type_name)
            wants_old = self.ros == 1 or qos.durability == "transient_local"
            if same and wants_old and publication.end.node != node and self.match(publication.qos, qos):
                for raw in publication.kept:
                    hear(raw)
        return subscription

    def match(self, offered: Qos, wanted: Qos) -> bool:
        """Return whether a publisher and a subscription match."""
        return self.ros == 1 or _match(offered, wanted)

    def is_latched(self, topic: str, type_name: str) -> bool:
        """Return whether a publisher declares a ROS 1 topic as latched; ROS 2 uses QoS instead."""
        return self.ros == 1 and any(
            (each.end.name, each.end.type_name, each.qos.durability) == (topic, type_name, "transient_local")
            for each in self.publications
        )

    def serve(
        self, node: str, name: str, type_name: str, ask: Callable[[bytes, Callable[[bytes | str], None]], None]
    ) -> Server:
        """Add a node's server."""
        server = Server(self, self._end(Role.SERVES, node, name, type_name, None), ask)
        self.servers.append(server)
        self.changed()
        return server

    def call(self, name: str, raw: bytes, done: Callable[[bytes | str], None]) -> None:
        """Call the first server of a name; ``done`` gets a response, or a reason at once if there is none."""
        server = next((server for server in self.servers if server.end.name == name), None)
        if server is None:
            done("no server")
        else:
            server.ask(raw, done)

    def subscriptions(self, topic: str, type_name: str) -> list[Subscription]:
        """Return the subscriptions of a topic."""
        return [each for each in self.readers if (each.end.name, each.end.type_name) == (topic, type_name)]

    def ends(self) -> list[GraphEntity]:
        """Return everything in the graph."""
        topics = [*(each.end for each in self.publications), *(each.end for each in self.readers)]
        return [*topics, *(each.end for each in self.servers)]

    def changed(self) -> None:
        """Notify the endpoints."""
        for endpoint in self.endpoints:
            endpoint.tell(GraphChanged())

    def _end(self, role: Role, node: str, name: str, type_name: str, qos: Qos | None) -> GraphEntity:
        return GraphEntity(role, name, type_name, node, str(next(self._keys)), qos=qos if self.ros == 2 else None)


@dataclass(slots=True)
class _Open:
    close: Callable[[], None]
    publication: Publication | None = None
    name: str = ""
    calls: set[int] = field(default_factory=set)
    tickets: dict[int, Callable[[bytes | str], None]] = field(default_factory=dict)


class FakeEndpoint:
    """An endpoint in a graph in memory."""

    def __init__(self, graph: FakeGraph, node: str) -> None:
        self._graph = graph
        self._node = node
        self._nodes: Mapping[str, Graph] = {}  # far ones
        self._shown: dict[str, tuple[Graph, list[Publication | Subscription]]] = {}
        self._events = deque[Event]()
        self._open: dict[int, _Open] = {}
        self._numbers = count(1)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        graph.endpoints.append(self)
        self.tell(GraphChanged())

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version."""
        return self._graph.ros

    @property
    def is_live(self) -> bool:
        """Return True: other nodes take part in the graph."""
        return True

    @property
    def label(self) -> str:
        """Return the display name."""
        return f"fake ros{self._graph.ros}"

    @property
    def dropped(self) -> int:
        """Return 0: there is no queue."""
        return 0

    @property
    def handles(self) -> int:
        """Return the number of open handles."""
        return len(self._open)

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll_events`` has events."""
        return self._wake

    def tell(self, event: Event) -> None:
        """Queue an event for the proxy."""
        if not self._events:
            os.eventfd_write(self._wake, 1)
        self._events.append(event)

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events."""
        if not self._events:
            return ()
        os.eventfd_read(self._wake)
        events = list(self._events)
        self._events.clear()
        return [each for each in events if isinstance(each, GraphChanged) or each.handle in self._open]

    def graph(self) -> Graph:
        """Return the entities of other nodes."""
        return frozenset(end for end in self._graph.ends() if end.node not in (self._node, *self._nodes))

    def set_nodes(self, nodes: Mapping[str, Graph]) -> None:
        """Replace the far nodes; what they own is not moved."""
        for node, (ends, shown) in list(self._shown.items()):
            if nodes.get(node) != ends:
                for each in shown:
                    each.close()
                del self._shown[node]
        self._nodes = nodes
        for node, ends in sorted(nodes.items()):
            if node not in self._shown:
                self._shown[node] = (
                    ends,
                    [
                        self._graph.publish(node, end.name, end.type_name, end.qos)
                        if end.role is Role.PUBLISHES
                        else self._graph.subscribe(node, end.name, end.type_name, lambda _: None, end.qos)
                        for end in ends
                        if end.role in (Role.PUBLISHES, Role.SUBSCRIBES)
                    ],
                )

    def _owner(self, role: Role, name: str) -> str:
        has = (node for node, ends in self._nodes.items() if any((end.role, end.name) == (role, name) for end in ends))
        return min(has, default=self._node)

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return this machine's description of a type."""
        known = self._graph.channels.get(type_name)
        if known is None:
            raise LocalError(f"{type_name}: not installed")
        return replace(known, topic=topic)

    def service(self, name: str, type_name: str) -> Service:
        """Return this machine's description of a service type."""
        known = self._graph.services.get(type_name)
        if known is None:
            raise LocalError(f"{type_name}: not installed")
        return replace(known, name=name)

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Subscribe to a topic."""
        channel, handle = self.channel(topic, type_name), next(self._numbers)
        self._open[handle] = _Open(lambda: None)

        def describe() -> None:
            self.tell(TypeResolved(handle, replace(channel, latched=self._graph.is_latched(topic, type_name))))

        def hear(raw: bytes) -> None:
            self.tell(MessageReceived(handle, self._graph.now_ns(), raw))

        describe()
        subscription = self._graph.subscribe(self._node, topic, type_name, hear, qos, describe)
        self._open[handle].close = subscription.close
        return handle

    def advertise(self, channel: Channel) -> int:
        """Create a publisher."""
        qos = channel.qos[0] if channel.qos else default(latched=channel.latched, depth=1)
        publication = self._graph.publish(self._node, channel.topic, channel.type_name, qos)
        return self._add(_Open(publication.close, publication))

    def publish(self, handle: int, raw: bytes) -> None:
        """Publish one message."""
        publication = self._open[handle].publication
        if publication is None:
            raise LocalError(f"handle {handle} is no publisher")
        publication.publish(raw)

    def serve(self, service: Service) -> int:
        """Create a server."""
        opened = _Open(lambda: None)
        handle = self._add(opened)

        def ask(raw: bytes, done: Callable[[bytes | str], None]) -> None:
            ticket = next(self._numbers)
            opened.tickets[ticket] = done
            self.tell(RequestReceived(handle, ticket, raw))

        opened.close = self._graph.serve(
            self._owner(Role.SERVES, service.name), service.name, service.type_name, ask
        ).close
        return handle

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a request."""
        done = self._open[handle].tickets.pop(ticket, None)
        if done is not None:
            done(raw)

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Fail a request."""
        done = self._open[handle].tickets.pop(ticket, None)
        if done is not None:
            done(reason)

    def create_client(self, name: str, type_name: str) -> int:
        """Create a client."""
        self.service(name, type_name)
        return self._add(_Open(lambda: None, name=name))

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Send a request."""
        opened = self._open[handle]
        opened.calls.add(call)

        def done(outcome: bytes | str) -> None:
            if call in opened.calls:
                opened.calls.discard(call)
                said = (
                    CallFailed(handle, call, outcome)
                    if isinstance(outcome, str)
                    else ResponseReceived(handle, call, outcome)
                )
                self.tell(said)

        self._graph.call(opened.name, raw, done)

    def drop(self, handle: int, call: int) -> None:
        """Forget a call."""
        self._open[handle].calls.discard(call)

    def close(self, handle: int) -> None:
        """Close a handle."""
        self._open.pop(handle).close()

    def shut_down(self) -> None:
        """Leave the graph."""
        for handle in list(self._open):
            self.close(handle)
        self._graph.endpoints.remove(self)
        os.close(self._wake)

    def _add(self, opened: _Open) -> int:
        handle = next(self._numbers)
        self._open[handle] = opened
        return handle


def _match(offered: Qos, wanted: Qos) -> bool:
    if wanted.reliability == "reliable" and offered.reliability != "reliable":
        return False
    return wanted.durability != "transient_local" or offered.durability == "transient_local"
