"""Probe endpoint: a graph whose one node reads one topic or calls one service, within the process of a command.

I/O only for its descriptor: no middleware and no thread takes part.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from itertools import count

from gdp.errors import LocalError
from proxy.doors.types import known_channel
from proxy.endpoints.core.endpoint import Event, Graph, GraphEntity, RequestReceived, Role
from proxy.serial.channel import Channel, Qos, RosVersion
from proxy.serial.service import Service

__all__ = ["Probe"]

_NODE = "/gdp_tool"
_TICKET = 1

OnMessage = Callable[[Channel, bytes, float], None]  # channel, CDR, monotonic seconds


class Probe:
    """Endpoint of one command.

    Args:
        topic: name and type to read; None: it reads nothing.
        on_message: called for each message.

    Attributes:
        served: the service that can be called now; None: no server is reachable.
        response: of the one request, in CDR.
        refusal: why the request has no response; empty while it may still come.
    """

    def __init__(self, topic: tuple[str, str] | None = None, on_message: OnMessage = lambda *_: None) -> None:
        self._graph: Graph = frozenset(
            () if topic is None else (GraphEntity(Role.SUBSCRIBES, *topic, _NODE, f"{_NODE}:{topic}"),)
        )
        self._on_message = on_message
        self._handles = count(1)
        self._channels: dict[int, Channel] = {}
        self._server: int | None = None
        self._events: list[Event] = []
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.served: Service | None = None
        self.response: bytes | None = None
        self.refusal = ""

    @property
    def ros(self) -> RosVersion:
        """Return the dialect of its messages: CDR."""
        return 2

    @property
    def label(self) -> str:
        """Return the display name."""
        return "tool"

    @property
    def is_live(self) -> bool:
        """Return True: it begins at any time."""
        return True

    @property
    def dropped(self) -> int:
        """Return 0: there is no queue."""
        return 0

    def fileno(self) -> int:
        """Return a descriptor that is readable while there are events."""
        return self._wake

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events."""
        events, self._events = self._events, []
        if events:
            os.eventfd_read(self._wake)
        return events

    def graph(self) -> Graph:
        """Return the command's node."""
        return self._graph

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return a standard type; any other is read from a publisher. Raises ``LocalError``: it is none."""
        return known_channel(topic, type_name)

    def service(self, name: str, type_name: str) -> Service:
        """Raise ``LocalError``: the definition of a server is used."""
        raise LocalError(f"{name}: a tool has no definition of {type_name}; that of its server is used")

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Raise ``LocalError``: a tool publishes nothing."""
        del qos
        raise LocalError(f"{topic}: a tool publishes no {type_name}")

    def advertise(self, channel: Channel) -> int:
        """Take the messages of a topic."""
        handle = next(self._handles)
        self._channels[handle] = channel
        return handle

    def publish(self, handle: int, raw: bytes) -> None:
        """Pass a message to the command."""
        self._on_message(self._channels[handle], raw, time.monotonic())

    def serve(self, service: Service) -> int:
        """Note that the service can be called."""
        self._server = next(self._handles)
        self.served = service
        return self._server

    def begin_call(self, raw: bytes) -> None:
        """Call the service once. Raises ``LocalError``: no server is reachable."""
        if self._server is None:
            raise LocalError("no server is reachable")
        self._events.append(RequestReceived(self._server, _TICKET, raw))
        os.eventfd_write(self._wake, 1)

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Take the response."""
        del handle, ticket
        self.response = raw

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Take the reason for which there is no response."""
        del handle, ticket
        self.refusal = reason

    def create_client(self, name: str, type_name: str) -> int:
        """Raise ``LocalError``: a tool serves nothing."""
        raise LocalError(f"{name}: a tool cannot serve {type_name}")

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Raise ``LocalError``: see ``create_client``."""
        del call, raw
        raise LocalError(f"handle {handle} is no client")

    def drop(self, handle: int, call: int) -> None:
        """Do nothing: no call was begun."""

    def close(self, handle: int) -> None:
        """Close a publisher or a server."""
        self._channels.pop(handle, None)
        if handle == self._server:
            self._server, self.served = None, None

    def shut_down(self) -> None:
        """Close the descriptor."""
        os.close(self._wake)
