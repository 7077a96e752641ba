"""Services of the rospy process: servers and clients.

I/O; imports rospy. rospy runs a thread for each client's connection. A separate thread runs each call, over a
connection of its own that it keeps for a while.
"""

from __future__ import annotations

import ast
import itertools
import queue
import threading
from collections.abc import Iterator
from typing import Final

import rospy
from rospy.exceptions import ROSInternalException, TransportInitError
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.tcpros_service import ServiceProxy

from gdp.intervals import CONNECT_S, IDLE_S
from gdp.ports.readiness import readable
from proxy.endpoints.ros1.ipc import IpcLink, Kind
from proxy.endpoints.ros1.raw import KnownMessage, KnownService, Raw, raw_service, ros1_name

_WORKERS: Final = 64  # calls of one service under way at once; further calls wait
_SAID_MAX: Final = 4_096  # characters of a server's error text
_RESPONDED: Final = " responded with an error: "
_CANNOT: Final = "service cannot process request: "


class Server:
    """One virtual server."""

    def __init__(self, link: IpcLink, handle: int, name: str, known: KnownService, tickets: Iterator[int]) -> None:
        self.name = name
        self.known = known
        self._link = link
        self._handle = handle
        self._class = raw_service(known)
        self._tickets = tickets
        self._waiting: dict[int, queue.SimpleQueue[bytes | str]] = {}
        self._is_closed = False
        self._service: rospy.Service | None = None

    def register(self) -> None:
        """Offer the service."""
        self._service = rospy.Service(self.name, self._class, self._serve)

    def close(self) -> None:
        """Unregister the service, and fail waiting requests."""
        self._is_closed = True
        if self._service is not None:
            self._service.shutdown("closed")
        for reply in list(self._waiting.values()):
            reply.put("the service is no longer offered")

    def reply(self, ticket: int, response: bytes | str) -> None:
        """Answer with bytes, or fail with a text; an unknown ticket's client is gone."""
        waiting = self._waiting.get(ticket)
        if waiting is not None:
            waiting.put(response)

    def _serve(self, request: Raw) -> Raw:
        ticket = next(self._tickets)
        reply: queue.SimpleQueue[bytes | str] = queue.SimpleQueue()
        self._waiting[ticket] = reply
        try:
            if self._is_closed:
                raise rospy.ServiceException("the service is no longer offered")
            if not self._link.send(Kind.ASKED, self._handle, ticket, request._buff):
                raise rospy.ServiceException("too much waits for the proxy")
            response = reply.get()
        finally:
            del self._waiting[ticket]
        if isinstance(response, str):
            raise rospy.ServiceException(response)
        return self._class._response_class(response)


class Client:
    """One client."""

    def __init__(self, link: IpcLink, handle: int, name: str, type_name: str) -> None:
        self._link = link
        self._handle = handle
        self._name = name
        self._type = ros1_name(type_name)
        anything = KnownMessage(self._type, "*", "")
        self._class = raw_service(KnownService(self._type, "*", anything, anything))
        self._work: queue.SimpleQueue[tuple[int, bytes] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._workers = 0
        self._idle = 0
        self._calls: dict[int, ServiceProxy | None] = {}  # under way; with its connection once it has one
        self._is_closed = False

    def call(self, call: int, raw: bytes) -> None:
        """Send a request, on a thread."""
        with self._lock:
            self._calls[call] = None
            is_new = self._idle < self._work.qsize() + 1 and self._workers < _WORKERS
            self._workers += is_new
            self._work.put((call, raw))
        if is_new:
            threading.Thread(target=self._run, name="call", daemon=True).start()

    def drop(self, call: int) -> None:
        """Forget a call and close its connection: its response could not be distinguished from the next one's."""
        with self._lock:
            proxy = self._calls.pop(call, None)
        if proxy is not None:
            proxy.close()

    def close(self) -> None:
        """Forget all calls and end all threads."""
        self._is_closed = True
        for call in list(self._calls):
            self.drop(call)
        for _ in range(_WORKERS):
            self._work.put(None)

    def _run(self) -> None:
        proxy: ServiceProxy | None = None
        while True:
            with self._lock:
                self._idle += 1
            try:
                work = self._work.get(timeout=IDLE_S)
            except queue.Empty:
                work = None
            with self._lock:
                self._idle -= 1
                if work is None and (self._is_closed or self._work.empty()):
                    self._workers -= 1
                    break
            if work is not None:
                proxy = self._one(proxy, *work)
        if proxy is not None:
            proxy.close()

    def _one(self, proxy: ServiceProxy | None, call: int, raw: bytes) -> ServiceProxy | None:
        """Make one call and return the connection if it is still good."""
        if proxy is not None and _has_ended(proxy):
            proxy.close()
            proxy = None
        if proxy is None:
            proxy = ServiceProxy(self._name, self._class, persistent=True)
        with self._lock:
            if call not in self._calls:
                return proxy
            self._calls[call] = proxy
        response, failure, is_good = self._ask(proxy, raw)
        with self._lock:
            is_wanted = call in self._calls
            self._calls.pop(call, None)
        if is_wanted and failure:
            self._link.send(Kind.FAILED, self._handle, call, failure.encode())
        elif is_wanted:
            self._link.send(Kind.ANSWERED, self._handle, call, response)
        if is_good and is_wanted:
            return proxy
        proxy.close()
        return None

    def _ask(self, proxy: ServiceProxy, raw: bytes) -> tuple[bytes, str, bool]:
        """Return the response, or why there is none, and whether the connection is still good."""
        request = self._class._request_class(raw)
        try:
            if proxy.transport is None:
                transport = self._connect(proxy, request)
                if transport.type != self._type:
                    transport.close()
                    return b"", f"{self._name} is a {transport.type} now, not a {self._type}", False
                proxy.transport = transport
            response: bytes = proxy.call(request)._buff
        except rospy.ServiceException as error:
            return b"", _reason(error), _RESPONDED in str(error)
        except TransportInitError as error:
            return b"", f"its server cannot be reached: {error}", False
        except (rospy.ROSException, ROSInternalException, OSError, AttributeError) as error:
            return b"", f"the call broke off: {error}", False  # AttributeError: rospy, closed during the call
        return response, "", True

    def _connect(self, proxy: ServiceProxy, request: Raw) -> TCPROSTransport:
        """Connect like rospy's first call, but separately: the present server may have another type."""
        uri = proxy._get_service_uri(request)
        host, port = rospy.core.parse_rosrpc_uri(uri)
        transport = TCPROSTransport(proxy.protocol, proxy.resolved_name)
        transport.connect(host, port, uri, timeout=CONNECT_S)
        return transport


def tickets(incarnation_id: int) -> Iterator[int]:
    """Return numbers that no earlier rospy process of this endpoint has used."""
    return itertools.count((incarnation_id << 40) + 1)


def _has_ended(proxy: ServiceProxy) -> bool:
    """Return whether an idle connection is readable, which can only mean its end."""
    transport = proxy.transport
    if transport is None or transport.done or transport.socket is None:
        return True
    return bool(readable([transport.socket], 0))


def _reason(error: Exception) -> str:
    """Return the server's error text without rospy's wrapping, or rospy's own text."""
    _, found, tail = str(error).partition(_RESPONDED)
    if not found:
        return str(error)
    tail = tail[:_SAID_MAX]
    try:
        said = ast.literal_eval(tail)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return tail
    text = said.decode("utf-8", "replace") if isinstance(said, bytes) else str(said)
    return text.removeprefix(_CANNOT)
