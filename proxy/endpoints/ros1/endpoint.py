"""ROS 1 endpoint in the proxy: forwards every operation to a rospy process, and returns its events.

I/O, by ``rospy_process.py``. When the process ends, or its master restarts, another process is started and all handles
are established again; until then the handles are faulted.
"""

from __future__ import annotations

import itertools
import os
import select
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

import cbor2

from gdp.errors import LocalError, RemoteError
from proxy.endpoints.core.endpoint import (
    CallFailed,
    EndpointError,
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
from proxy.endpoints.ros1.install import rospy_folder
from proxy.endpoints.ros1.ipc import Frame, IpcLink, Kind, LinkEndedError
from proxy.endpoints.ros1.rospy_process import RospyProcess
from proxy.serial.channel import Channel, Qos, RosVersion, Service


@dataclass(slots=True)
class _Held:
    """Definition of a handle, sufficient to establish it again.

    Args:
        kind: of the frame that establishes it, with ``payload``.
        kept: last messages of a latched publisher.
    """

    kind: Kind
    payload: bytes
    kept: deque[bytes] | None = None
    subscribers: int = 0
    calls: set[int] = field(default_factory=set)


class Ros1Endpoint:
    """One ROS 1 graph, with one virtual node in it."""

    ros: Final[RosVersion] = 1
    is_live: Final = True

    def __init__(self, master_uri: str, node: str) -> None:
        """Start the rospy process; it joins the graph as soon as the master answers.

        Raises:
            LocalError: rospy is not installed.
        """
        rospy_folder()
        self.label = f"ros1 {master_uri}"
        self._numbers = itertools.count(1)
        self._held: dict[int, _Held] = {}
        self._events: list[Event] = []
        self._graph: Graph = frozenset()
        self._is_graph_old = True  # the next snapshot counts as a change, whatever it shows
        self._trouble = ""  # the present fault; also reported to handles created while it lasts
        self._answers: dict[int, bytes | None] = {}
        self._known: dict[tuple[Kind, str, str], bytes] = {}
        self._lost = 0  # by the present process
        self._lost_before = 0
        self._woken = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._rospy = RospyProcess(master_uri, node)
        self._rospy.epoll.register(self._woken, select.EPOLLIN)

    @property
    def dropped(self) -> int:
        """Return the number of messages dropped between the two processes, oldest of a topic first."""
        return self._rospy.dropped + self._lost_before + self._lost

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll_events`` has events."""
        return self._rospy.epoll.fileno()

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events, in order."""
        self._pump()
        if self._events:
            with suppress(BlockingIOError):  # no wake-up was needed
                os.eventfd_read(self._woken)
        events, self._events = self._events, []
        return events

    def graph(self) -> Graph:
        """Return the present entities."""
        return self._graph

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return an installed ROS 1 package's description of a type; may block up to a second."""
        wire = self._ask(Kind.ASK_CHANNEL, topic, type_name)
        if wire is None:
            raise LocalError(f"{type_name} is not known here as a ROS 1 type: install its ROS 1 package")
        return Channel.from_cbor(wire)

    def service(self, name: str, type_name: str) -> Service:
        """Return an installed package's description of a type, or, without definitions, that of a live server."""
        wire = self._ask(Kind.ASK_SERVICE, name, type_name)
        if wire is None:
            raise LocalError(f"{type_name} is not known here as a ROS 1 service type: install its ROS 1 package")
        return Service.from_cbor(wire)

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:  # noqa: ARG002  # of any type and QoS
        """Subscribe to a topic, whatever its publishers' type."""
        return self._hold(_Held(Kind.SUBSCRIBE, topic.encode()))

    def advertise(self, channel: Channel) -> int:
        """Create a publisher; if a local node contradicts, ``EndpointError`` follows."""
        if channel.ros != 1 or not (channel.hash or channel.definition_format):
            here = self.channel(channel.topic, channel.type_name)
            channel = replace(here, qos=channel.qos, latched=channel.latched, callerid=channel.callerid)
        depth = max(1, channel.qos[0].depth) if channel.qos else 1
        kept: deque[bytes] | None = deque(maxlen=depth) if channel.latched else None
        return self._hold(_Held(Kind.ADVERTISE, channel.to_wire(), kept))

    def publish(self, handle: int, raw: bytes) -> None:
        """Publish one message."""
        held = self._held[handle]
        if held.kept is not None:
            held.kept.append(raw)
        self._rospy.link.send(Kind.PUBLISH, handle, 0, raw)

    def subscribers(self, handle: int) -> int:
        """Return the present number of local subscriptions of a publisher."""
        return self._held[handle].subscribers

    def serve(self, service: Service) -> int:
        """Create a server; if a local node contradicts, ``EndpointError`` follows."""
        if service.ros != 1:
            service = self.service(service.name, service.type_name)
        return self._hold(_Held(Kind.SERVE, service.to_cbor()))

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a request."""
        self._rospy.link.send(Kind.ANSWER, handle, ticket, raw)

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Fail a request: its client gets a ``ServiceException`` with the reason."""
        self._rospy.link.send(Kind.REFUSE, handle, ticket, reason.encode())

    def create_client(self, name: str, type_name: str) -> int:
        """Create a client of a local service; only its type's name need be known."""
        return self._hold(_Held(Kind.DIAL, cbor2.dumps([name, type_name])))

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Send a request."""
        self._held[handle].calls.add(call)
        if not self._rospy.link.send(Kind.CALL, handle, call, raw):
            self._fail(handle, call, "too much waits for the rospy process")

    def drop(self, handle: int, call: int) -> None:
        """Forget a call."""
        held = self._held.get(handle)
        if held is not None and call in held.calls:
            held.calls.discard(call)
            self._rospy.link.send(Kind.DROP, handle, call)

    def close(self, handle: int) -> None:
        """Close a subscription, publisher, server or client."""
        if self._held.pop(handle, None) is not None:
            self._rospy.link.send(Kind.CLOSE, handle)
            self._events = [event for event in self._events if getattr(event, "handle", None) != handle]

    def shut_down(self) -> None:
        """Leave the graph; may block two seconds while the process unregisters from the master."""
        self._rospy.close()
        os.close(self._woken)

    # the process

    def _establish(self, handle: int, held: _Held) -> None:
        self._rospy.link.send(held.kind, handle, 0, held.payload)
        for raw in held.kept or ():
            self._rospy.link.send(Kind.PUBLISH, handle, 0, raw)

    def _restart(self) -> None:
        """Fail the calls under way after the process has ended, and start another, with a growing delay."""
        self._lost_before += self._lost
        self._lost = 0
        if not self._trouble:
            self._suffer("the rospy process has ended")
        for handle, held in self._held.items():
            held.subscribers = 0
            for call in sorted(held.calls):
                self._fail(handle, call, self._trouble)
        self._is_graph_old = True
        self._rospy.restart()
        for handle, held in self._held.items():
            self._establish(handle, held)

    def _pump(self) -> None:
        """Transfer frames on the link without blocking."""
        try:
            frames = self._rospy.poll_frames()
        except LinkEndedError:
            self._restart()
            return
        for frame in frames:
            self._arrive(frame)

    def _arrive(self, frame: Frame) -> None:
        kind, handle, number, payload = frame
        if kind in (Kind.KNOWN, Kind.UNKNOWN):
            self._answers[number] = payload if kind is Kind.KNOWN else None
        elif kind is Kind.GRAPH:
            graph = _graph_of(payload)
            if graph != self._graph or self._is_graph_old:
                self._events.append(GraphChanged())
            self._graph, self._is_graph_old, self._trouble = graph, False, ""
        elif kind is Kind.LOST:
            self._lost = number
        elif kind is Kind.ENDING or (kind is Kind.FAULTED and not handle):
            self._suffer(payload.decode())
        elif handle in self._held:
            self._happen(kind, handle, number, payload)

    def _happen(self, kind: Kind, handle: int, number: int, payload: bytes) -> None:
        held = self._held[handle]
        if kind is Kind.HEARD:
            self._events.append(MessageReceived(handle, number, payload))
        elif kind is Kind.ASKED:
            self._events.append(RequestReceived(handle, number, payload))
        elif kind is Kind.ANSWERED and number in held.calls:
            held.calls.discard(number)
            self._events.append(ResponseReceived(handle, number, payload))
        elif kind is Kind.FAILED:
            self._fail(handle, number, payload.decode())
        elif kind is Kind.FAULTED:
            self._events.append(EndpointError(handle, payload.decode()))
        elif kind is Kind.COUNTED:
            held.subscribers = number
        elif kind is Kind.DESCRIBED:
            try:
                self._events.append(TypeResolved(handle, Channel.from_cbor(payload)))
            except RemoteError as error:
                self._events.append(EndpointError(handle, f"its publisher describes it badly: {error}"))

    # handles

    def _hold(self, held: _Held) -> int:
        handle = next(self._numbers)
        self._held[handle] = held
        self._establish(handle, held)
        if self._trouble:
            self._tell(EndpointError(handle, self._trouble, is_graph=True))
        return handle

    def _suffer(self, reason: str) -> None:
        if not self._trouble:
            self._events += [EndpointError(handle, reason, is_graph=True) for handle in self._held]
        self._trouble = reason

    def _fail(self, handle: int, call: int, reason: str) -> None:
        if call in self._held[handle].calls:
            self._held[handle].calls.discard(call)
            self._tell(CallFailed(handle, call, reason))

    def _tell(self, event: Event) -> None:
        self._events.append(event)
        os.eventfd_write(self._woken, 1)

    def _ask(self, kind: Kind, name: str, type_name: str) -> bytes | None:
        """Query the process, wait for its response, and keep events that arrive meanwhile for ``poll_events``."""
        known = self._known.get((kind, name, type_name))
        if known is not None:
            return known
        question = next(self._numbers)
        self._rospy.link.send(kind, 0, question, cbor2.dumps([name, type_name]))
        until_s = self._rospy.answers_by_s
        while question not in self._answers:
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                raise LocalError(f"{type_name}: the rospy process does not answer")
            _wait(self._rospy.link, left_s)
            self._pump()
        if self._events:
            os.eventfd_write(self._woken, 1)
        answer = self._answers.pop(question)
        if answer is not None:
            self._known[kind, name, type_name] = answer
        return answer


def _graph_of(payload: bytes) -> Graph:
    return frozenset(
        GraphEntity(Role(role), name, type_name, node, node, hash=md5)
        for role, name, type_name, node, md5 in cbor2.loads(payload)
    )


def _wait(link: IpcLink, patience_s: float) -> None:
    poller = select.poll()
    poller.register(link, select.POLLIN | (select.POLLOUT if link.is_behind else 0))
    poller.poll(patience_s * 1000)
