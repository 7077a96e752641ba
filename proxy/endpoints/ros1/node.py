"""Node of rospy: executes the commands of the IPC link, and reports events.

I/O; imports rospy. It has three threads, and rospy adds its own:
- The main thread serves the link and never waits for ROS.
- The registrar adds entities to the graph and removes them, which waits for the master.
- The watch polls the graph.
"""

from __future__ import annotations

import logging
import os
import queue
import select
import threading
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Final, TypeAlias

import cbor2
import rospy
import rospy.core
from rospy.impl import masterslave, tcpros_base
from rospy.impl.registration import RegManager, get_registration_listeners, get_service_manager, get_topic_manager

from gdp.errors import LocalError, RemoteError
from gdp.intervals import ANSWER_S, TICK_S
from proxy.endpoints.core.reconnect import MissingConnections
from proxy.endpoints.ros1.ipc import Frame, IpcLink, Kind, LinkEndedError
from proxy.endpoints.ros1.master import GraphSnapshot, LocalEnd, Master, MasterError, MasterWatch
from proxy.endpoints.ros1.raw import (
    installed_message,
    installed_service,
    known_message,
    known_service,
    ros1_name,
    ros2_name,
)
from proxy.endpoints.ros1.services import Client, Server, tickets
from proxy.endpoints.ros1.topics import Publisher, Subscriber
from proxy.serial.channel import Channel, Service, ros1_format

_Connected: TypeAlias = tuple[int, str, int]

_BACKLOG: Final = 128


class Node:
    """One node on one master."""

    def __init__(
        self, *, link: IpcLink, woken: int, master: str, node: str, incarnation_id: int, delay_s: float
    ) -> None:
        self._link = link
        self._woken = woken
        self._master = master
        self._name = node
        self._id = f"/{node}"
        self._delay_s = delay_s
        self._tickets = tickets(incarnation_id)
        self._inlets: dict[int, Subscriber] = {}
        self._outlets: dict[int, Publisher] = {}
        self._servers: dict[int, Server] = {}
        self._dials: dict[int, Client] = {}
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._refused: dict[int, str] = {}  # not on the graph, with the reason; owned by the registrar
        self._snapshot: GraphSnapshot | None = None
        self._missing = MissingConnections[LocalEnd]()  # owned by the watch
        self._stopped = threading.Event()
        self._lost = 0

    def run(self) -> None:
        """Serve the link until it ends; does not return."""
        logging.getLogger().addHandler(logging.NullHandler())
        rospy.core.configure_logging = lambda *_: None  # write no log files to ~/.ros
        threading.excepthook = self._broke
        threading.Thread(target=self._register, name="registrar", daemon=True).start()
        poller = select.poll()
        poller.register(self._woken, select.POLLIN)
        while True:
            poller.register(self._link, select.POLLIN | (select.POLLOUT if self._link.is_behind else 0))
            for descriptor, _ in poller.poll():
                if descriptor == self._woken:
                    os.eventfd_read(self._woken)
            self._link.flush()
            try:
                frames = self._link.poll_frames()
            except LinkEndedError:
                self._leave()
            for frame in frames:
                self._handle_frame(frame)

    # the link

    def _handle_frame(self, frame: Frame) -> None:
        kind, handle, number, payload = frame
        if kind is Kind.PUBLISH:
            if handle in self._outlets:
                self._outlets[handle].publish(payload)
        elif kind is Kind.CALL:
            self._dials[handle].call(number, payload)
        elif kind is Kind.DROP:
            self._dials[handle].drop(number)
        elif kind in (Kind.ANSWER, Kind.REFUSE):
            if handle in self._servers:
                self._servers[handle].reply(number, payload if kind is Kind.ANSWER else payload.decode())
        elif kind is Kind.CLOSE:
            self._close(handle)
        elif kind in (Kind.ASK_CHANNEL, Kind.ASK_SERVICE):
            self._tell(kind, number, payload)
        else:
            try:
                self._make(kind, handle, payload)
            except (LocalError, RemoteError) as error:
                self._link.send(Kind.FAULTED, handle, 0, str(error).encode())

    def _make(self, kind: Kind, handle: int, payload: bytes) -> None:
        if kind is Kind.SUBSCRIBE:
            inlet = self._inlets[handle] = Subscriber(self._link, handle, payload.decode(), self._id)
            self._todo.put(inlet.register)
        elif kind is Kind.DIAL:
            name, type_name = cbor2.loads(payload)
            self._dials[handle] = Client(self._link, handle, name, type_name)
        elif kind is Kind.ADVERTISE:
            channel = Channel.from_cbor(payload)
            self._outlets[handle] = Publisher(self._link, handle, channel, known_message(channel), self._id)
            self._todo.put(lambda: self._join(handle))
        elif kind is Kind.SERVE:
            service = Service.from_cbor(payload)
            known = known_service(service)
            self._servers[handle] = Server(self._link, handle, service.name, known, self._tickets)
            self._todo.put(lambda: self._join(handle))

    def _close(self, handle: int) -> None:
        dial = self._dials.pop(handle, None)
        if dial is not None:
            dial.close()
        ended = self._inlets.pop(handle, None) or self._outlets.pop(handle, None) or self._servers.pop(handle, None)
        if ended is not None:
            self._todo.put(ended.close)
            self._todo.put(lambda: self._forget(handle))

    def _tell(self, kind: Kind, question: int, payload: bytes) -> None:
        """Report the known description of a type."""
        name, type_name = cbor2.loads(payload)
        known = self._channel(name, type_name) if kind is Kind.ASK_CHANNEL else self._service(name, type_name)
        if known is None:
            self._link.send(Kind.UNKNOWN, 0, question)
        else:
            self._link.send(Kind.KNOWN, 0, question, known)

    def _channel(self, topic: str, type_name: str) -> bytes | None:
        known = installed_message(type_name)
        return None if known is None else _channel(topic, type_name, known.md5, known.text).to_wire()

    def _service(self, name: str, type_name: str) -> bytes | None:
        request, response = f"{type_name}_Request", f"{type_name}_Response"
        known = installed_service(type_name)
        if known is not None:
            parts = (
                _channel(name, request, known.request.md5, known.request.text),
                _channel(name, response, known.response.md5, known.response.text),
            )
            return Service(name, type_name, known.md5, *parts).to_cbor()
        for end in self._snapshot.ends if self._snapshot is not None else ():
            if (end.role, end.name, end.type_name) == ("serves", name, ros1_name(type_name)):
                parts = _channel(name, request, "", ""), _channel(name, response, "", "")
                return Service(name, type_name, end.md5, *parts).to_cbor()
        return None

    # the registrar

    def _register(self) -> None:
        self._stopped.wait(self._delay_s)
        self._await_master()
        if self._stopped.is_set():
            return
        masterslave.ROSHandler._connect_topic = _to_others(masterslave.ROSHandler._connect_topic)
        rospy.init_node(self._name, argv=["gdp"], disable_rosout=True, disable_rostime=True, disable_signals=True)
        # 50 clients may connect at once, and rospy's backlog is five.
        tcpros_base._tcpros_server.tcp_ros_server.server_sock.listen(_BACKLOG)
        watch = MasterWatch(self._master, self._id)
        threading.Thread(
            target=watch.run, args=(self._stopped, self._seen, self._silent), name="watch", daemon=True
        ).start()
        while True:
            self._todo.get()()

    def _await_master(self) -> None:
        master = Master(self._master, self._id)
        is_reported = False
        while not self._stopped.is_set():
            try:
                master.call_batch(("getPid",))
                return
            except MasterError as error:
                if not is_reported:
                    self._silent(str(error))
                is_reported = True
            self._stopped.wait(TICK_S)

    def _join(self, handle: int) -> None:
        """Add a publisher or server to the graph, unless an entity there contradicts it."""
        subject = self._outlets.get(handle) or self._servers.get(handle)
        if subject is None:
            return
        reason = self._against(subject)
        if not reason:
            self._refused.pop(handle, None)
            subject.register()
        elif self._refused.get(handle) != reason:
            self._refused[handle] = reason
            self._link.send(Kind.FAULTED, handle, 0, reason.encode())

    def _forget(self, handle: int) -> None:
        self._refused.pop(handle, None)

    def _against(self, subject: Publisher | Server) -> str:
        look = self._snapshot
        if isinstance(subject, Server):
            other = look.servers.get(subject.name) if look is not None else None
            if other is not None:
                return f"{subject.name} is served here by {other}"
            if get_service_manager().get_service(subject.name) is not None:
                return f"{subject.name} is served by this proxy already"
            return ""
        ends = look.ends if look is not None else ()
        for end in sorted(end for end in ends if end.name == subject.topic):
            if self._is_other_type(end, subject.known.name):
                return f"{subject.topic} is a {end.type_name} here ({end.node}), not a {subject.known.name}"
        ours = get_topic_manager().get_publisher_impl(subject.topic)
        if ours is not None and ours.data_class._md5sum != subject.known.md5:
            return f"{subject.topic} is published by this proxy as {ours.type} with another definition"
        return ""

    def _is_other_type(self, end: LocalEnd, type_name: str) -> bool:
        """Return whether a publisher or subscriber contradicts a type: tools that read any type do not."""
        if end.role == "serves" or end.type_name == type_name:
            return False
        if end.role == "publishes":
            return True
        with closing(Master(self._master, self._id)) as master:
            return master.subscribed_type(end.node, end.name) not in {"*", type_name}

    # the watch

    def _seen(self, snapshot: GraphSnapshot) -> None:
        if rospy.is_shutdown():
            self._end("the node was shut down from outside")
        if not snapshot.is_ours_known:
            self._end(f"the ROS 1 master at {self._master} was restarted")
        if self._snapshot is None or snapshot.ends != self._snapshot.ends:
            self._link.send(Kind.GRAPH, payload=cbor2.dumps([_end(end) for end in snapshot.ends]))
        is_news = self._snapshot is None or (snapshot.ends, snapshot.servers) != (
            self._snapshot.ends,
            self._snapshot.servers,
        )
        self._snapshot = snapshot
        if is_news:
            self._todo.put(self._retry)
        self._remind(snapshot)
        if self._link.dropped != self._lost:
            self._lost = self._link.dropped
            self._link.send(Kind.LOST, number=self._lost)

    def _remind(self, snapshot: GraphSnapshot) -> None:
        """Announce connections again that are missing for long, see ``reconnect``."""
        peers: dict[tuple[str, str], set[str]] = {}  # connected nodes by the other end's role and topic
        for outlet in list(self._outlets.values()):
            peers.setdefault(("subscribes", outlet.topic), set()).update(outlet.peers())
        for inlet in list(self._inlets.values()):
            peers.setdefault(("publishes", inlet.topic), set()).update(inlet.peers())
        missing = {end for end in snapshot.ends if end.node not in peers.get((end.role, end.name), {end.node})}
        for end in self._missing.due(missing, time.monotonic()):
            self._todo.put(partial(self._announce, end))

    def _announce(self, end: LocalEnd) -> None:
        """Let the subscriber of a missing connection learn of the publisher again."""
        manager = get_topic_manager()
        master = Master(self._master, self._id)
        try:
            if end.role == "subscribes" and manager.has_publication(end.name):
                known = manager.get_publisher_impl(end.name).type
                master.call_batch(("registerPublisher", end.name, known, rospy.core.get_node_uri()))
            elif end.role == "publishes" and manager.has_subscription(end.name):
                (uri,) = master.call_batch(("lookupNode", end.node))
                for listener in get_registration_listeners().listeners:
                    if uri is not None and isinstance(listener, RegManager):
                        listener.publisher_update(end.name, [uri])
        except MasterError:
            return  # the watch reports it, and the reminder comes again
        finally:
            master.close()

    def _retry(self) -> None:
        for handle in list(self._refused):
            self._join(handle)

    def _silent(self, error: str) -> None:
        reason = f"the ROS 1 master at {self._master} does not answer: {error}"
        self._link.send(Kind.FAULTED, payload=reason.encode())

    # the end

    def _broke(self, broken: threading.ExceptHookArgs) -> None:
        """End the process if a thread of its own fails; rospy's threads fail when a peer leaves at a bad moment."""
        name = "" if broken.thread is None else broken.thread.name
        if name in ("registrar", "watch", "call") and not self._stopped.is_set():
            self._end(f"{name}: {broken.exc_type.__name__}: {broken.exc_value}")

    def _end(self, reason: str) -> None:
        self._link.send(Kind.ENDING, payload=reason.encode())
        os._exit(1)  # rospy's threads would keep the process alive

    def _leave(self) -> None:
        """Unregister from the master, if it responds, and end."""
        self._stopped.set()
        farewell = threading.Thread(target=rospy.signal_shutdown, args=("the proxy has ended",), daemon=True)
        farewell.start()
        farewell.join(ANSWER_S)
        os._exit(0)


def _to_others(connect: Callable[[object, str, str], _Connected]) -> Callable[[object, str, str], _Connected]:
    """Prevent rospy from sending this node's publications to its own subscriptions over TCP."""

    def connect_topic(handler: object, topic: str, publisher: str) -> _Connected:
        return (1, "ours", 0) if publisher == rospy.core.get_node_uri() else connect(handler, topic, publisher)

    return connect_topic


def _channel(topic: str, type_name: str, md5: str, text: str) -> Channel:
    return Channel(topic, type_name, 1, hash=md5, definition=text, definition_format=ros1_format(text, md5))


def _end(end: LocalEnd) -> list[str]:
    kind = "srv" if end.role == "serves" else "msg"
    return [end.role, end.name, ros2_name(end.type_name, kind), end.node, end.md5]
