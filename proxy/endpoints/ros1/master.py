"""Master poller of a ROS 1 graph: a master does not push changes, so it is queried twice a second.

I/O; XML-RPC to the master, TCP to nodes and servers. Runs in the rospy process, on its own thread, but does not use
rospy.
Source: ROS wiki, Master API and TCPROS header. A master keeps nodes that died without unregistering, and does not know
service types. So a node whose port refuses is omitted until it answers again, and a probe asks each server for its
type.
"""

from __future__ import annotations

import http.client
import socket
import struct
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError

from gdp.intervals import ANSWER_S, POLL_S, PROMPT_S, TICK_S

_LENGTH: Final = struct.Struct("<I")
_HEADER_MAX: Final = 1 << 20
_ANSWER_MAX_BYTES: Final = 16 << 20
_PIECE_BYTES: Final = 64 << 10
_REASON_MAX: Final = 300


# These are raised by xmlrpc.client for an answer that is not XML-RPC; the parser's handlers fail in many ways.
_FOREIGN: Final = (
    OSError,
    xmlrpc.client.Error,
    http.client.HTTPException,
    ExpatError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    MemoryError,
    RecursionError,
)


class MasterError(Exception):
    """The master, a node or a server does not answer, or answers wrongly."""


class LocalEnd(NamedTuple):
    """One graph entity in the terms of ROS 1; ``role`` is a value of ``Role``."""

    role: str
    name: str
    type_name: str
    node: str
    md5: str


@dataclass(frozen=True, slots=True)
class GraphSnapshot:
    """Result of one poll of the master.

    Args:
        ends: of all other nodes that are alive, with a known type.
        servers: of all other services, service to node.
        is_ours_known: the master knows this node.
    """

    ends: frozenset[LocalEnd]
    servers: dict[str, str]
    is_ours_known: bool


class _Transport(xmlrpc.client.Transport):
    accept_gzip_encoding = False

    def make_connection(self, host: tuple[str, dict[str, str]] | str) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = ANSWER_S
        return connection

    def parse_response(self, response: http.client.HTTPResponse) -> tuple[Any, ...]:
        """Read a response uninterpreted, unpacked and at most ``_ANSWER_MAX_BYTES`` long."""
        if response.getheader("Content-Encoding", ""):
            raise MasterError("an answer in an encoding that was not asked for")
        parser, target = self.getparser()
        left = _ANSWER_MAX_BYTES
        while data := response.read(_PIECE_BYTES):
            left -= len(data)
            if left < 0:
                raise MasterError(f"an answer of more than {_ANSWER_MAX_BYTES} bytes")
            parser.feed(data)
        parser.close()
        return target.close()


class Master:
    """XML-RPC client of a master with timeouts. Used from one thread."""

    def __init__(self, uri: str, node: str) -> None:
        self._proxy = xmlrpc.client.ServerProxy(uri, transport=_Transport())
        self._node = node

    def call_batch(self, *calls: tuple[str, ...]) -> list[object]:
        """Return the responses to a batch of calls, each (method, argument...); None for a refused call.

        Raises:
            MasterError: no response at all.
        """
        several = xmlrpc.client.MultiCall(self._proxy)
        for method, *arguments in calls:
            getattr(several, method)(self._node, *arguments)
        try:
            answers = several()
            return [_value(answers[index]) for index in range(len(calls))]
        except MasterError:
            self._proxy("close")()
            raise
        except _FOREIGN as error:
            self._proxy("close")()
            raise MasterError(str(error)[:_REASON_MAX] or type(error).__name__) from error

    def subscribed_type(self, node: str, topic: str) -> str:
        """Return the type that a node reads a topic as, ``*`` for any; "" if it does not say.

        The master knows one type of a topic, and keeps that when its publisher is gone. Source: ROS wiki, Slave API.
        """
        try:
            (uri,) = self.call_batch(("lookupNode", node))
            with closing(Master(str(uri), self._node)) as slave:
                (named,) = slave.call_batch(("getSubscriptions",))
            return dict(_pairs(named)).get(topic, "")
        except (MasterError, OSError):  # OSError: an address of another protocol
            return ""

    def close(self) -> None:
        """Close the connection; the next request opens another."""
        self._proxy("close")()


class MasterWatch:
    """Periodic polling of the graph."""

    def __init__(self, uri: str, node: str) -> None:
        self._master = Master(uri, node)
        self._node = node
        self._probes = ThreadPoolExecutor(8, "probe")
        self._services: dict[tuple[str, str], _Server] = {}
        self._dead: frozenset[str] = frozenset()
        self._next_liveness_s = 0.0

    def poll(self) -> GraphSnapshot:
        """Query the master, and probe new servers for their types.

        Raises:
            MasterError: the master does not answer.
        """
        state, named = self._master.call_batch(("getSystemState",), ("getTopicTypes",))
        publishers, subscribers, servers = _state(state)
        types = dict(_pairs(named))
        ours = any(self._node in nodes for _, nodes in servers)
        self._check_alive({node for _, nodes in (*publishers, *subscribers, *servers) for node in nodes} - {self._node})
        ends = []
        for role, topics in (("publishes", publishers), ("subscribes", subscribers)):
            for topic, nodes in topics:
                type_name = types.get(topic, "*")
                if type_name != "*":
                    ends += [LocalEnd(role, topic, type_name, node, "") for node in nodes if self._is_seen(node)]
        offered = {(service, node) for service, nodes in servers for node in nodes if self._is_seen(node)}
        self._probe(offered)
        for service, node in offered:
            server = self._services.get((service, node))
            if server is not None and server.type_name:
                ends.append(LocalEnd("serves", service, server.type_name, node, server.md5))
        return GraphSnapshot(frozenset(ends), dict(offered), ours)

    def run(
        self, stopped: threading.Event, seen: Callable[[GraphSnapshot], None], failed: Callable[[str], None]
    ) -> None:
        """Poll until ``stopped``; ``failed`` is called once for every outage."""
        is_silent = False
        while not stopped.is_set():
            try:
                look = self.poll()
            except MasterError as error:
                if not is_silent:
                    failed(str(error))
                is_silent = True
            else:
                is_silent = False
                seen(look)
            stopped.wait(TICK_S)

    def _is_seen(self, node: str) -> bool:
        return node != self._node and node not in self._dead

    def _check_alive(self, nodes: set[str]) -> None:
        """Probe every node periodically, and dead ones at each poll: a restarted node has a new port."""
        dead = self._dead & nodes
        doubtful = dead
        if time.monotonic() >= self._next_liveness_s:
            self._next_liveness_s = time.monotonic() + POLL_S
            doubtful = frozenset(nodes)
        if doubtful:
            order = sorted(doubtful)
            uris = self._master.call_batch(*(("lookupNode", node) for node in order))
            refused = self._probes.map(_refuses, uris)
            dead = frozenset(node for node, is_refused in zip(order, refused, strict=True) if is_refused)
        self._dead = dead

    def _probe(self, offered: set[tuple[str, str]]) -> None:
        self._services = {key: server for key, server in self._services.items() if key in offered}
        now_s = time.monotonic()
        order = sorted(key for key in offered if key not in self._services or now_s >= self._services[key].next_probe_s)
        if order:
            uris = self._master.call_batch(*(("lookupService", service) for service, _ in order))
            for key, server in zip(order, self._probes.map(_probed, (name for name, _ in order), uris), strict=True):
                self._services[key] = server


@dataclass(frozen=True, slots=True)
class _Server:
    type_name: str
    md5: str
    next_probe_s: float  # monotonic


def _probed(service: str, uri: object) -> _Server:
    """Probe a server for its type, again at the next poll if it does not respond, else after ten seconds."""
    now_s = time.monotonic()
    fields = {"probe": "1", "md5sum": "*", "callerid": "/gdp_probe", "service": service}
    try:
        with _connected(uri) as sock:
            sock.sendall(_header(fields))
            answer = _read_header(sock)
    except (OSError, MasterError):
        return _Server("", "", now_s)
    return _Server(answer.get("type", ""), answer.get("md5sum", ""), now_s + 10.0)


def _refuses(uri: object) -> bool:
    try:
        with _connected(uri):
            return False
    except ConnectionRefusedError:
        return True
    except (OSError, MasterError):
        return False  # unreachable or busy: not known to be dead


def _connected(uri: object) -> socket.socket:
    """Connect to ``http://host:port/`` or ``rosrpc://host:port``."""
    try:
        parts = urlsplit(str(uri))
        if uri is None or parts.hostname is None or parts.port is None:
            raise MasterError("no address")
        return socket.create_connection((parts.hostname, parts.port), timeout=PROMPT_S)
    except ValueError as error:
        raise MasterError("no address") from error


def _header(fields: dict[str, str]) -> bytes:
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    body = b"".join(_LENGTH.pack(len(line)) + line for line in lines)
    return _LENGTH.pack(len(body)) + body


def _read_header(sock: socket.socket) -> dict[str, str]:
    (length,) = _LENGTH.unpack(_exactly(sock, 4))
    if length > _HEADER_MAX:
        raise MasterError("a header of absurd length")
    body = _exactly(sock, length)
    fields = {}
    at = 0
    while at + 4 <= length:
        (size,) = _LENGTH.unpack_from(body, at)
        if at + 4 + size > length:
            raise MasterError("a header that is none")
        key, _, value = body[at + 4 : at + 4 + size].decode("utf-8", "replace").partition("=")
        fields[key] = value
        at += 4 + size
    return fields


def _exactly(sock: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = sock.recv(count - len(data))
        if not piece:
            raise MasterError("the connection ended")
        data += piece
    return data


def _value(answer: object) -> object:
    """Return the value of a call's response, which is (code, text, value)."""
    if not isinstance(answer, list) or len(answer) != 3:
        raise MasterError("an answer that is none")
    return answer[2] if answer[0] == 1 else None


def _state(state: object) -> tuple[list[tuple[str, list[str]]], ...]:
    """Return publishers, subscribers, servers: each (name, nodes)."""
    if not isinstance(state, list) or len(state) != 3:
        raise MasterError("a state that is none")
    try:
        return tuple([(str(name), [str(node) for node in nodes]) for name, nodes in part] for part in state)
    except (TypeError, ValueError) as error:
        raise MasterError("a state that is none") from error


def _pairs(named: object) -> Iterable[tuple[str, str]]:
    if not isinstance(named, list):
        raise MasterError("topic types that are none")
    try:
        return [(str(topic), str(type_name)) for topic, type_name in named]
    except (TypeError, ValueError) as error:
        raise MasterError("topic types that are none") from error
