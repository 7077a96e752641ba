"""HTTP server for scrapes and probes, on the loopback address, in one thread.

I/O. Every local user may connect, so everything is bounded: concurrent connections, bytes of a request, seconds of a
connection, and connections and responses per second. A connection beyond a bound closes at once. One thread serves all,
so neither threads nor descriptors of the node grow with the number of connections.
Source: RFC 9112 (HTTP/1.1), sections 2 and 9.6: one response, then the connection closes.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gdp.telemetry.health import PROBES, Health, probe
from gdp.token_bucket import TokenBucket

__all__ = ["CONNECTIONS_MAX", "CONNECTION_S", "REQUEST_MAX_BYTES", "ScrapeServer"]

log = logging.getLogger(__name__)

CONNECTIONS_MAX: Final = 4
CONNECTION_S: Final = 5.0  # from its first byte to its end, even if the client reads slowly
REQUEST_MAX_BYTES: Final = 8 * 1024
_LOOPBACK: Final = "127.0.0.1"
_BACKLOG: Final = 128
_ACCEPTS_PER_S: Final = 500.0  # about 20 us each
_ANSWERS_PER_S: Final = 20.0  # a few ms each; a scraper polls every few seconds
_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_JSON: Final = "application/json"
_END: Final = (b"\r\n\r\n", b"\n\n")


@dataclass(slots=True)
class _Connection:
    """One active scrape; it ends at ``end_s`` at the latest."""

    peer: socket.socket
    end_s: float
    request: bytes = b""
    answer: bytes = b""


class ScrapeServer:
    """Server of GET with the present text; the paths of ``PROBES`` give the state of the node instead.

    Args:
        port: of 127.0.0.1; 0: the system chooses.
        text: called in the server's thread, once for each response.
        health: called for each probe; None: the node has no probes, and they get 404.

    Raises:
        OSError: the port is in use.
    """

    def __init__(self, port: int, text: Callable[[], bytes], health: Callable[[], Health] | None = None) -> None:
        self._text = text
        self._health = health
        self._accepts, self._answers = (TokenBucket(each, each) for each in (_ACCEPTS_PER_S, _ANSWERS_PER_S))
        self._connections: dict[int, _Connection] = {}
        self._resume_s: float | None = None  # when the server accepts connections again
        self._is_closed = False
        self._listener = socket.create_server((_LOOPBACK, port), backlog=_BACKLOG)
        self._listener.setblocking(False)
        self._woken, self._wakes = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name="metrics", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Return the port that the server listens on."""
        return int(self._listener.getsockname()[1])

    def close(self) -> None:
        """End all connections, and return when the port is free again."""
        self._is_closed = True
        self._wakes.send(b"x")
        self._thread.join()
        for connection in list(self._connections.values()):
            self._end(connection)
        self._selector.close()
        for each in (self._listener, self._woken, self._wakes):
            each.close()

    def _serve(self) -> None:
        while not self._is_closed:
            for key, events in self._selector.select(self._timeout_s()):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fd in self._connections:
                    self._proceed(self._connections[key.fd], events)
            now_s = time.monotonic()
            for connection in [each for each in self._connections.values() if each.end_s <= now_s]:
                self._end(connection)
            if self._resume_s is not None and self._resume_s <= now_s:
                self._resume_s = None
                self._selector.register(self._listener, selectors.EVENT_READ)

    def _timeout_s(self) -> float | None:
        ends = [each.end_s for each in self._connections.values()]
        ends += [] if self._resume_s is None else [self._resume_s]
        return max(min(ends) - time.monotonic(), 0.0) if ends else None

    def _accept(self) -> None:
        now_s = time.monotonic()
        if not self._accepts.spend(now_s):
            self._pause(now_s)
            return
        try:
            peer, _ = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:  # no descriptors left, which this thread cannot repair
            log.warning("scrape not accepted reason=%s", error.strerror)
            self._pause(now_s)
            return
        if len(self._connections) >= CONNECTIONS_MAX:
            peer.close()
            return
        peer.setblocking(False)
        self._connections[peer.fileno()] = _Connection(peer, now_s + CONNECTION_S)
        self._selector.register(peer, selectors.EVENT_READ)

    def _pause(self, now_s: float) -> None:
        """Leave further connections in the kernel's queue for a moment."""
        self._selector.unregister(self._listener)
        self._resume_s = now_s + 10.0 / _ACCEPTS_PER_S

    def _proceed(self, connection: _Connection, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                self._read(connection)
            if events & selectors.EVENT_WRITE:
                self._write(connection)
        except BlockingIOError:
            return
        except OSError:  # the scraper closed the connection
            self._end(connection)

    def _read(self, connection: _Connection) -> None:
        data = connection.peer.recv(REQUEST_MAX_BYTES)
        connection.request += data
        if not data or len(connection.request) > REQUEST_MAX_BYTES:
            self._end(connection)
        elif any(end in connection.request for end in _END):
            connection.answer = self._answer_to(connection.request)
            self._selector.modify(connection.peer, selectors.EVENT_WRITE)

    def _write(self, connection: _Connection) -> None:
        sent = connection.peer.send(connection.answer)
        connection.answer = connection.answer[sent:]
        if not connection.answer:
            with contextlib.suppress(OSError):
                connection.peer.shutdown(socket.SHUT_WR)
            self._end(connection)

    def _answer_to(self, request: bytes) -> bytes:
        method, _, rest = request.partition(b" ")
        path = rest.split(maxsplit=1)[0].partition(b"?")[0].decode(errors="replace") if rest.split() else ""
        if method not in (b"GET", b"HEAD"):
            return _answer("405 Method Not Allowed", b"")
        if not self._answers.spend(time.monotonic()):
            return _answer("503 Service Unavailable", b"")
        is_head = method == b"HEAD"
        if path in PROBES:
            if self._health is None:
                return _answer("404 Not Found", b"")
            is_good, state = probe(path, self._health(), time.monotonic())
            status = "200 OK" if is_good else "503 Service Unavailable"
            return _answer(status, state, is_head=is_head, content_type=_JSON)
        try:
            body = self._text()
        except Exception:  # a source of the node failed; the node itself continues
            log.exception("scrape failed")
            return _answer("500 Internal Server Error", b"")
        return _answer("200 OK", body, is_head=is_head)

    def _end(self, connection: _Connection) -> None:
        del self._connections[connection.peer.fileno()]
        self._selector.unregister(connection.peer)
        connection.peer.close()


def _answer(status: str, body: bytes, *, is_head: bool = False, content_type: str = _TYPE) -> bytes:
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + (b"" if is_head else body)
