"""What every endpoint does: look at a ROS graph, take part in it as one virtual node, and move raw messages.

Place: pure; ``ros2``, ``ros1``, ``dds``, ``fake`` and ``proxy/recordings/endpoint.py`` do the I/O. An endpoint speaks
one dialect and knows nothing of names, rules or the overlay. All methods are called from one thread and none of them
waits; whatever an endpoint runs beside that (a wait set, another process) is its own business.

Handles are whole numbers of the endpoint's choosing, never used twice in its life. After ``close(handle)`` no event
names it any more.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple, Protocol, TypeAlias

from proxy.serial.channel import Channel, Qos, RosVersion
from proxy.serial.service import Service

__all__ = [
    "CallFailed",
    "Endpoint",
    "EndpointError",
    "Event",
    "Graph",
    "GraphChanged",
    "GraphEntity",
    "MessageReceived",
    "RequestReceived",
    "ResponseReceived",
    "Role",
    "TypeResolved",
    "is_proxy_node",
    "proxy_node_name",
]

_PROXY_NODE: Final = re.compile(r"gdp_proxy_[0-9a-f]{12}(_[0-9a-z_]*)?\Z")


class Role(Enum):
    """What a node does with a name."""

    PUBLISHES = "publishes"
    SUBSCRIBES = "subscribes"
    SERVES = "serves"
    CALLS = "calls"  # ROS 1 masters do not know their clients


@dataclass(frozen=True, slots=True)
class GraphEntity:
    """One end in the graph: a node's publisher, subscription, server or client; never one of this endpoint's own.

    Args:
        role: what the node does.
        name: fully qualified, as the robot calls it (``/camera/image``); ROS 2 actions show as their hidden parts
            (``/fold/_action/send_goal``).
        type_name: as ROS 2 writes it (``sensor_msgs/msg/Image``, ``std_srvs/srv/SetBool``), for ROS 1 too; empty while
            unknown.
        node: fully qualified name of the node; empty while unknown.
        key: tells the ends of one name apart: a GID in hex, or the node's name.
        hash: md5 sum or ``RIHS01_...``; empty where unknown.
        qos: offered or requested, ROS 2 topics only.
    """

    role: Role
    name: str
    type_name: str
    node: str
    key: str
    hash: str = ""
    qos: Qos | None = None

    @property
    def is_proxy(self) -> bool:
        """Return whether the end belongs to the virtual node of another proxy."""
        return is_proxy_node(self.node)


Graph: TypeAlias = frozenset[GraphEntity]


class GraphChanged(NamedTuple):
    """``graph()`` has news."""


class TypeResolved(NamedTuple):
    """What the messages of a subscription are; comes before its first ``MessageReceived``, and again if that changes.

    ``others`` are the channels of further publishers, where the endpoint tells publishers apart: a recording does.
    """

    handle: int
    channel: Channel
    others: tuple[Channel, ...] = ()


class MessageReceived(NamedTuple):
    """One message of a subscription; never one that this endpoint published itself."""

    handle: int
    stamp_ns: int  # wall clock, when the endpoint took it
    raw: bytes  # the channel's wire form: CDR with its four bytes of encapsulation, or ROS 1
    channel: int = 0  # 0: ``TypeResolved.channel``; n: number n - 1 of ``TypeResolved.others``


class RequestReceived(NamedTuple):
    """A local client's request to a virtual server, to be answered or failed under this ticket."""

    handle: int
    ticket: int
    raw: bytes


class ResponseReceived(NamedTuple):
    """A local server's response to ``call``."""

    handle: int
    call: int
    raw: bytes


class CallFailed(NamedTuple):
    """A call that got no response, and why."""

    handle: int
    call: int
    reason: str


class EndpointError(NamedTuple):
    """Something about a handle's name is wrong and stays so until the graph changes; the handle stays open."""

    handle: int
    reason: str
    is_graph: bool = False  # it is the whole graph that cannot be had


Event: TypeAlias = (
    GraphChanged | TypeResolved | MessageReceived | RequestReceived | ResponseReceived | CallFailed | EndpointError
)


class Endpoint(Protocol):
    """One ROS graph, with this process in it as one virtual node."""

    @property
    def ros(self) -> RosVersion:
        """Return which ROS it speaks."""

    @property
    def label(self) -> str:
        """Return what people call it, such as ``ros2 domain 0`` or ``ros1 http://localhost:11311``."""

    @property
    def is_live(self) -> bool:
        """Return whether nodes and other bridges take part in it; a recording has neither, and keeps every channel."""

    @property
    def dropped(self) -> int:
        """Return how many messages it let go for want of room; what a middleware drops by its QoS is not known."""

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``take`` has something."""

    def poll_events(self) -> Sequence[Event]:
        """Return, once, what happened, in order."""

    def graph(self) -> Graph:
        """Return who is there, as far as known; at most a second old."""

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return how this machine knows a topic type: hash and full definition text.

        Raises:
            LocalError: it does not; the text says what to install.
        """

    def service(self, name: str, type_name: str) -> Service:
        """Return how this machine knows a service type.

        Raises:
            LocalError: it does not.
        """

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Hear a topic from now on.

        Args:
            qos: to request; None: the default of a reliable topic. ROS 1 ignores it.

        Raises:
            LocalError: the type is not known here.
        """

    def advertise(self, channel: Channel) -> int:
        """Be a publisher of ``channel.topic``; offer ``channel.qos[0]``, or latch as ``channel.latched`` says.

        What is published reaches late joiners of a latched or transient local channel, as many as its depth says.

        Raises:
            LocalError: the type is not known here, or a local one of that name has another definition.
        """

    def publish(self, handle: int, raw: bytes) -> None:
        """Publish one message, in the wire form of the channel.

        Raises:
            LocalError: a recording cannot be written.
        """

    def subscribers(self, handle: int) -> int:
        """Return how many local subscriptions a publisher of ours has now."""

    def serve(self, service: Service) -> int:
        """Be the server of ``service.name``; requests come as ``RequestReceived``.

        Raises:
            LocalError: the type is not known here.
        """

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a request; an unknown ticket is ignored: its client is gone."""

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Fail a request with a reason, as far as the dialect can say one; its client must not hang if it can."""

    def create_client(self, name: str, type_name: str) -> int:
        """Be a client of a local service.

        Raises:
            LocalError: the type is not known here.
        """

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Send a request under a number of the caller's; ``ResponseReceived`` or ``CallFailed`` follows, unless it is
        dropped.

        Any number of calls may be under way; the caller keeps the time.
        """

    def drop(self, handle: int, call: int) -> None:
        """Forget a call: its response, should it come, is nobody's."""

    def close(self, handle: int) -> None:
        """End a subscription, publisher, server or client."""

    def remove_entity(self) -> None:
        """Leave the graph and free everything; no method is called afterwards."""


def proxy_node_name(name_hex: str, suffix: str = "") -> str:
    """Return what the virtual node of the proxy with this GDP name (64 hex digits) is called."""
    return f"gdp_proxy_{name_hex[:12]}{'_' + suffix if suffix else ''}"


def is_proxy_node(node: str) -> bool:
    """Return whether a node (fully qualified or not) is the virtual node of a proxy."""
    return _PROXY_NODE.match(node.rpartition("/")[2]) is not None
