"""Topics of the rospy process: subscriptions and publishers.

I/O; imports rospy. rospy calls ``Subscriber`` from a thread for each connection. The main thread calls
``Publisher.publish``, and the registrar adds publishers to the graph.
"""

from __future__ import annotations

import select
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

import rospy
from rospy.impl.registration import get_topic_manager

from proxy.endpoints.core.endpoint import is_proxy_node
from proxy.endpoints.ros1.ipc import IpcLink, Kind
from proxy.endpoints.ros1.raw import KnownMessage, Raw, raw_class, ros2_name
from proxy.serial.channel import Channel, ros1_format

_QUEUE: Final = 100  # messages in the queue of one slow subscriber


class _Connection(Protocol):
    header: dict[str, str] | None
    endpoint_id: str
    callerid_pub: str


class Subscriber:
    """One subscription: reports the type of the messages, then forwards them."""

    def __init__(self, link: IpcLink, handle: int, topic: str, node: str) -> None:
        self._link = link
        self._handle = handle
        self.topic = topic
        self._node = node
        self._lock = threading.Lock()  # one connection's description must not overtake another's message
        # by identity; the reference keeps the identity valid
        self._headers: dict[int, tuple[dict[str, str], bool]] = {}
        self._type: tuple[str, str] | None = None
        self._described: Channel | None = None
        self._subscriber: rospy.Subscriber | None = None

    def register(self) -> None:
        """Subscribe."""
        self._subscriber = rospy.Subscriber(
            self.topic, rospy.AnyMsg, self._hear, queue_size=None, buff_size=1 << 18, tcp_nodelay=True
        )

    def close(self) -> None:
        """Unsubscribe."""
        if self._subscriber is not None:
            impl = self._subscriber.impl
            self._subscriber.unregister()
            _free(impl)

    def peers(self) -> set[str]:
        """Return the nodes of the connected publishers."""
        impl = get_topic_manager().get_subscriber_impl(self.topic)
        connections: list[_Connection] = getattr(impl, "connections", None) or []
        return {connection.callerid_pub for connection in connections}

    def _hear(self, message: Raw) -> None:
        stamp_ns = time.time_ns()
        header = message._connection_header
        with self._lock:
            known = self._headers.get(id(header))
            if known is None:
                known = self._headers[id(header)] = (header, self._is_wanted(header))
                self._describe()
            if known[1]:
                self._link.send(Kind.HEARD, self._handle, stamp_ns, message._buff)

    def _live(self) -> list[dict[str, str]]:
        impl = get_topic_manager().get_subscriber_impl(self.topic)
        connections: list[_Connection] = [] if impl is None else impl.connections
        return [connection.header for connection in connections if connection.header]

    def _is_wanted(self, header: dict[str, str]) -> bool:
        caller = header.get("callerid", "")
        if caller == self._node or is_proxy_node(caller):
            return False
        kind = header.get("type", ""), header.get("md5sum", "")
        live = {id(other) for other in self._live()}
        self._headers = {key: known for key, known in self._headers.items() if key in live}
        if self._type is None or not any(is_wanted for _, is_wanted in self._headers.values()):
            self._type = kind
        if kind == self._type:
            return True
        text = "{} has publishers of {} (md5 {}) and of {} (md5 {}, {}): the latter are not heard"
        reason = text.format(self.topic, *self._type, *kind, caller or "unnamed")
        self._link.send(Kind.FAULTED, self._handle, 0, reason.encode())
        return False

    def _describe(self) -> None:
        headers = [header for header, is_wanted in self._headers.values() if is_wanted]
        if not headers or self._type is None:
            return
        text = headers[0].get("message_definition", "")
        channel = Channel(
            topic=self.topic,
            type_name=ros2_name(self._type[0], "msg"),
            ros=1,
            hash=self._type[1],
            definition=text,
            definition_format=ros1_format(text, self._type[1]),
            latched=any(header.get("latching") == "1" for header in headers),
            callerid=headers[0].get("callerid") if len(headers) == 1 else None,
        )
        if channel != self._described:
            self._described = channel
            self._link.send(Kind.DESCRIBED, self._handle, 0, channel.to_wire())


class Publisher(rospy.SubscribeListener):  # type: ignore[misc]  # rospy is untyped
    """One publisher. A latched one keeps its last messages for every late joiner; rospy itself keeps only one."""

    def __init__(self, link: IpcLink, handle: int, channel: Channel, known: KnownMessage, node: str) -> None:
        self.topic = channel.topic
        self.known = known
        self._link = link
        self._handle = handle
        self._node = node
        self._class = raw_class(known)
        self._kept: deque[bytes] = deque(maxlen=_depth(channel) if channel.latched else 0)
        self._is_latched = channel.latched
        self._lock = threading.Lock()
        self._publisher: rospy.Publisher | None = None  # set once it is registered
        self._counted = 0

    def register(self) -> None:
        """Advertise."""
        headers = {"latching": "1"} if self._is_latched else None
        size = max(_QUEUE, self._kept.maxlen or 0)
        publisher = rospy.Publisher(
            self.topic, self._class, subscriber_listener=self, tcp_nodelay=True, headers=headers, queue_size=size
        )
        impl = publisher.impl
        if not hasattr(impl, "admit"):
            impl.admit = impl.add_connection
            impl.add_connection = _one_at_a_time(impl)
        with impl.publock:
            with self._lock:
                self._publisher = publisher
            for raw in self._kept:
                publisher.publish(self._class(raw))
            self._count()

    def publish(self, raw: bytes) -> None:
        """Publish to all subscribers, and keep the message if latched."""
        with self._lock:
            publisher = self._publisher
            if publisher is None:
                self._kept.append(raw)
                return
        with publisher.impl.publock:
            self._kept.append(raw)
            publisher.publish(self._class(raw))

    def close(self) -> None:
        """Leave the graph."""
        publisher = self._publisher
        if publisher is not None:
            impl = publisher.impl
            impl.subscriber_listeners.remove(self)
            publisher.unregister()
            _free(impl)

    def peers(self) -> set[str]:
        """Return the nodes of the connected subscribers."""
        impl = get_topic_manager().get_publisher_impl(self.topic)
        connections: list[_Connection] = getattr(impl, "connections", None) or []
        return {connection.endpoint_id for connection in connections}

    def peer_subscribe(
        self, _topic_name: str, _topic_publish: Callable[[Raw], None], peer_publish: Callable[[Raw], None]
    ) -> None:
        """Send the kept messages to a late joiner; rospy calls it under the lock of ``_one_at_a_time``."""
        if self._publisher is not None:
            for raw in self._kept:
                peer_publish(self._class(raw))
            self._count()

    def peer_unsubscribe(self, _topic_name: str, _num_peers: int) -> None:
        """Report that a subscriber has left; rospy still has it in its list."""
        self._count()

    def _count(self) -> None:
        impl = get_topic_manager().get_publisher_impl(self.topic)
        connections: list[_Connection] = [] if impl is None else impl.connections
        count = sum(connection.endpoint_id != self._node for connection in connections)
        if count != self._counted:
            self._counted = count
            self._link.send(Kind.COUNTED, self._handle, count)


class _Poller(Protocol):
    poller: select.epoll


class _Impl(Protocol):
    closed: bool
    connection_poll: _Poller
    publock: threading.RLock
    admit: Callable[[object], bool]


def _one_at_a_time(impl: _Impl) -> Callable[[object], bool]:
    """Serialise joins with publications, so that a late joiner does not get a kept message twice."""

    def add_connection(connection: object) -> bool:
        with impl.publock:
            return impl.admit(connection)

    return add_connection


def _free(impl: _Impl) -> None:
    """Close the descriptor that rospy leaves to the garbage collector, which may run a thousand topics later."""
    if impl.closed:
        impl.connection_poll.poller.close()


def _depth(channel: Channel) -> int:
    return max(1, channel.qos[0].depth) if channel.qos else 1
