"""Endpoint interface: observes a ROS graph, joins it as one virtual node, and transfers raw messages.

Sans-I/O; ``ros2``, ``ros1``, ``dds``, ``fake`` and ``proxy/recordings/endpoint.py`` do the I/O. An endpoint implements
one dialect and has no knowledge of overlay names, rules or the overlay. All methods are called from one thread and none
of them blocks. An endpoint may run a wait-set thread or another process internally.

Handles are integers that the endpoint chooses and never reuses. After ``close(handle)`` no event has that handle.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from enum import Enum
from functools import lru_cache
from typing import Final, NamedTuple, Protocol, TypeAlias, runtime_checkable

from proxy.serial.channel import Channel, Qos, RosVersion, Service

_PROXY_NODE: Final = re.compile(r"gdp_proxy_[0-9a-f]{12}(_[0-9a-z_]*)?\Z")
_NODES_MAX: Final = 4_096  # names of nodes that are kept with what they are


class Role(Enum):
    """Relation of a node to a name."""

    PUBLISHES = "publishes"
    SUBSCRIBES = "subscribes"
    SERVES = "serves"
    CALLS = "calls"  # never in ROS 1, whose masters do not know clients


@dataclass(frozen=True, slots=True)
class GraphEntity:
    """Graph entity: a node's publisher, subscription, server or client; never one of this endpoint's own.

    Args:
        role: the node's relation to the name.
        name: fully qualified local name (``/camera/image``); ROS 2 actions appear as their hidden parts
            (``/fold/_action/send_goal``).
        type_name: as ROS 2 writes it (``sensor_msgs/msg/Image``, ``std_srvs/srv/SetBool``), for ROS 1 too; empty while
            unknown.
        node: fully qualified name of the node; empty while unknown.
        key: distinguishes the entities of one name: a GID in hex, or the node's name.
        hash: md5 sum or ``RIHS01_...``; empty where unknown.
        qos: offered or requested, ROS 2 topics only.
    """

    role: Role
    name: str
    type_name: str
    node: str
    key: str
    _: KW_ONLY
    hash: str = ""
    qos: Qos | None = None

    @property
    def is_proxy(self) -> bool:
        """Return whether the entity belongs to the virtual node of another proxy."""
        return is_proxy_node(self.node)


Graph: TypeAlias = frozenset[GraphEntity]


class GraphChanged(NamedTuple):
    """Event: ``graph()`` has changed."""


class TypeResolved(NamedTuple):
    """Type of a subscription's messages; precedes its first ``MessageReceived``, and recurs if the type changes.

    ``others`` are the channels of further publishers, where the endpoint distinguishes publishers: a recording does.
    """

    handle: int
    channel: Channel
    others: tuple[Channel, ...] = ()


class MessageReceived(NamedTuple):
    """One message of a subscription; never one that this endpoint published itself."""

    handle: int
    stamp_ns: int  # wall clock, when the endpoint received it
    raw: bytes  # the channel's wire form: CDR with its four bytes of encapsulation, or ROS 1
    channel: int = 0  # 0: ``TypeResolved.channel``; n: number n - 1 of ``TypeResolved.others``


class Origin(NamedTuple):
    """What a far publisher says of one message."""

    published_ns: int  # Unix time at which its proxy took the message
    sequence: int  # which message of its publisher it is, from 1; skipped numbers are lost messages


class RequestReceived(NamedTuple):
    """A local client's request to a virtual server, to be answered or refused by its ticket."""

    handle: int
    ticket: int
    raw: bytes


class ResponseReceived(NamedTuple):
    """A local server's response to ``call``."""

    handle: int
    call: int
    raw: bytes


class CallFailed(NamedTuple):
    """A call that got no response, with the reason."""

    handle: int
    call: int
    reason: str


class EndpointError(NamedTuple):
    """A persistent fault of a handle's name, until the graph changes; the handle stays open."""

    handle: int
    reason: str
    is_graph: bool = False  # the whole graph is unavailable


Event: TypeAlias = (
    GraphChanged | TypeResolved | MessageReceived | RequestReceived | ResponseReceived | CallFailed | EndpointError
)


@runtime_checkable
class MessageRecorder(Protocol):
    """An endpoint that keeps what a far publisher says of each message."""

    def record(self, handle: int, raw: bytes, origin: Origin) -> None:
        """Record one message of a channel. Raises ``LocalError``: a recording cannot be written."""


@runtime_checkable
class NodeHost(Protocol):
    """An endpoint in whose graph far nodes can appear under their own names."""

    def set_nodes(self, nodes: Mapping[str, Graph]) -> None:
        """Replace the far nodes; each owns what is advertised, subscribed to and served of its entities' names.

        Of a name that several nodes have, the first one by name owns it. The others, and clients, only appear.
        """


class RosEndpoint(Protocol):
    """One ROS graph, with this process in it as one virtual node; an unknown type raises ``LocalError``."""

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version."""

    @property
    def label(self) -> str:
        """Return the display name, such as ``ros2 domain 0`` or ``ros1 http://localhost:11311``."""

    @property
    def is_live(self) -> bool:
        """Return whether nodes and other bridges take part in it; a recording has neither, and keeps every channel."""

    @property
    def dropped(self) -> int:
        """Return the messages dropped because a queue was full; those that a middleware drops are unknown."""

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll_events`` has events."""

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events, in order."""

    def graph(self) -> Graph:
        """Return the known entities, at most a second old."""

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return this machine's description of a topic type: hash and full definition text.

        Raises:
            LocalError: it has none; the text states what to install.
        """

    def service(self, name: str, type_name: str) -> Service:
        """Return this machine's description of a service type."""

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Subscribe to a topic; ``qos`` None: the default of a reliable topic. ROS 1 ignores it."""

    def advertise(self, channel: Channel) -> int:
        """Create a publisher of ``channel.topic`` with ``channel.qos[0]``, or latched as ``channel.latched`` states.

        Late joiners of a latched or transient local channel get its last messages, as many as its depth.

        Raises:
            LocalError: the type is not known here, or a local one of that name has another definition.
        """

    def publish(self, handle: int, raw: bytes) -> None:
        """Publish one message, in the wire form of the channel.

        Raises:
            LocalError: a recording cannot be written.
        """

    def serve(self, service: Service) -> int:
        """Create the server of ``service.name``; requests arrive as ``RequestReceived``."""

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a request; an unknown ticket is ignored: its client is gone."""

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Fail a request with a reason, as far as the dialect can express it; its client must not hang if possible."""

    def create_client(self, name: str, type_name: str) -> int:
        """Create a client of a local service."""

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Send a request under the caller's number; ``ResponseReceived`` or ``CallFailed`` follows.

        Nothing follows after ``drop``. Any number of calls may be under way; the caller keeps the timeouts.
        """

    def drop(self, handle: int, call: int) -> None:
        """Forget a call: a later response is discarded."""

    def close(self, handle: int) -> None:
        """Close a subscription, publisher, server or client."""

    def shut_down(self) -> None:
        """Leave the graph and free everything; no method is called afterwards."""


def proxy_node_name(name_hex: str, suffix: str = "") -> str:
    """Return the virtual node's name for the proxy with this GDP name (64 hex digits)."""
    return f"gdp_proxy_{name_hex[:12]}{'_' + suffix if suffix else ''}"


@lru_cache(_NODES_MAX)
def is_proxy_node(node: str) -> bool:
    """Return whether a node (fully qualified or not) is the virtual node of a proxy."""
    return _PROXY_NODE.match(node.rpartition("/")[2]) is not None
