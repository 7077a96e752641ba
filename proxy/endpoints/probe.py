"""Probe endpoint: a graph whose one node reads one topic or calls one service, within the process of a command.

I/O only for its descriptor: no middleware and no thread takes part.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Graph, GraphEntity, RequestReceived, Role
from proxy.endpoints.in_process import InProcessEndpoint
from proxy.serial.channel import Channel, Qos, Service
from proxy.serial.standard_types import known_channel

_NODE = "/gdp_tool"
_TICKET = 1

OnMessage = Callable[[Channel, bytes, float], None]  # channel, CDR, monotonic seconds


class Probe(InProcessEndpoint):
    """Endpoint of one command.

    Args:
        topic: name and type to read; None: it reads nothing.
        on_message: called for each message.

    Attributes:
        served: the service that can be called now; None: no server is reachable.
        response: of the one request, in CDR.
        refusal: why the request has no response; empty while it may still come.
    """

    kind = "a tool"

    def __init__(self, topic: tuple[str, str] | None = None, on_message: OnMessage = lambda *_: None) -> None:
        super().__init__()
        self._graph: Graph = frozenset(
            () if topic is None else (GraphEntity(Role.SUBSCRIBES, *topic, _NODE, f"{_NODE}:{topic}"),)
        )
        self._on_message = on_message
        self._handles = count(1)
        self._channels: dict[int, Channel] = {}
        self._server: int | None = None
        self.served: Service | None = None
        self.response: bytes | None = None
        self.refusal = ""

    @property
    def label(self) -> str:
        """Return the display name."""
        return "tool"

    def graph(self) -> Graph:
        """Return the command's node."""
        return self._graph

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return a standard type; any other is read from a publisher. Raises ``LocalError``: it is none."""
        return known_channel(topic, type_name)

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
        self._put(RequestReceived(self._server, _TICKET, raw))

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Take the response."""
        del handle, ticket
        self.response = raw

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Take the reason for which there is no response."""
        del handle, ticket
        self.refusal = reason

    def close(self, handle: int) -> None:
        """Close a publisher or a server."""
        self._channels.pop(handle, None)
        if handle == self._server:
            self._server, self.served = None, None
