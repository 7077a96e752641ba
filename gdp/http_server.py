"""HTTP server for a few small purposes, in one thread: scrapes and probes of a node, and the software of a site.

I/O. Anyone may connect, so everything is bounded: concurrent connections, bytes of a request, seconds of a connection,
and connections per second. Neither threads nor descriptors grow with the number of connections.
Source: RFC 9112 (HTTP/1.1), sections 2 and 9.6: one response, then the connection closes.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from gdp.token_bucket import TokenBucket

if TYPE_CHECKING:
    import ssl  # most nodes serve without TLS

__all__ = ["Answer", "HttpServer"]

log = logging.getLogger(__name__)

_REQUEST_MAX_BYTES: Final = 8 * 1024
_PIECE_BYTES: Final = 1 << 18
_ACCEPTS_PER_S: Final = 500.0  # about 20 us each
_END: Final = (b"\r\n\r\n", b"\n\n")


class Answer(NamedTuple):
    """A response; a path stands for the content of that file."""

    status: str
    body: bytes | Path = b""
    content_type: str = "application/octet-stream"


@dataclass(slots=True)
class _Connection:
    """One request and its response; it ends at ``end_s`` at the latest."""

    peer: socket.socket
    end_s: float
    request: bytes = b""
    pieces: Generator[bytes, None, None] | None = None
    unsent: bytes | memoryview = b""


class HttpServer:
    """Server of GET and HEAD on a listening socket, which it owns, until ``close``.

    Args:
        answer: returns the response for a path without its query; called in the server's thread, once for each request.
        connections: at once; one more closes at once.
        timeout_s: from the first byte of a connection to its end.
        tls: context of a server; None: plain HTTP.
        is_for_downloads: whether the time of a connection begins again with each piece that is sent, and the oldest
            connection without a response under way gives way to a new one.
    """

    def __init__(
        self,
        listener: socket.socket,
        answer: Callable[[str], Answer],
        *,
        name: str,
        connections: int,
        timeout_s: float,
        tls: ssl.SSLContext | None = None,
        is_for_downloads: bool = False,
    ) -> None:
        self._listener = listener
        self._answer = answer
        self._connections_max = connections
        self._timeout_for_s = timeout_s
        self._tls = tls
        self._is_for_downloads = is_for_downloads
        self._accepts = TokenBucket(_ACCEPTS_PER_S, _ACCEPTS_PER_S)
        self._connections: dict[int, _Connection] = {}  # the oldest first
        self._resume_s: float | None = None  # when the server accepts connections again
        self._is_closed = False
        self._listener.setblocking(False)
        self._woken, self._wakes = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
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
            for key, _ in self._selector.select(self._timeout_s()):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fd in self._connections:
                    self._proceed(self._connections[key.fd])
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
            log.warning("connection not accepted server=%s reason=%s", self._thread.name, error.strerror)
            self._pause(now_s)
            return
        if len(self._connections) >= self._connections_max:
            idle = (each for each in self._connections.values() if each.pieces is None and self._is_for_downloads)
            oldest = next(idle, None)
            if oldest is None:
                level = logging.WARNING if self._is_for_downloads else logging.DEBUG
                log.log(level, "connection refused server=%s reason=too many", self._thread.name)
                peer.close()
                return
            self._end(oldest)
        peer.setblocking(False)
        if self._tls is not None:
            peer = self._tls.wrap_socket(peer, server_side=True, do_handshake_on_connect=False)
        self._connections[peer.fileno()] = _Connection(peer, now_s + self._timeout_for_s)
        self._selector.register(peer, selectors.EVENT_READ)

    def _pause(self, now_s: float) -> None:
        """Leave further connections in the kernel's queue for a moment."""
        self._selector.unregister(self._listener)
        self._resume_s = now_s + 10.0 / _ACCEPTS_PER_S

    def _proceed(self, connection: _Connection) -> None:
        events = selectors.EVENT_READ if connection.pieces is None else selectors.EVENT_WRITE
        try:
            if connection.pieces is None:
                self._read(connection)
            else:
                self._write(connection)
        except BlockingIOError:
            pass
        except OSError as error:  # TLS waits, or the other end closed the connection
            events = 0 if self._tls is None else _awaited(error)
            if not events:
                log.debug("connection ended server=%s reason=%s", self._thread.name, error)
        else:
            events = selectors.EVENT_READ if connection.pieces is None else selectors.EVENT_WRITE
        if connection.peer.fileno() in self._connections:
            if events:
                self._selector.modify(connection.peer, events)
            else:
                self._end(connection)

    def _read(self, connection: _Connection) -> None:
        while connection.pieces is None:  # TLS may hold more than the kernel shows
            data = connection.peer.recv(_REQUEST_MAX_BYTES)
            connection.request += data
            if not data or len(connection.request) > _REQUEST_MAX_BYTES:
                self._end(connection)
                return
            if any(end in connection.request for end in _END):
                connection.pieces = self._pieces(connection.request)

    def _write(self, connection: _Connection) -> None:
        assert connection.pieces is not None
        connection.unsent = connection.unsent or memoryview(next(connection.pieces, b""))
        if not connection.unsent:
            with contextlib.suppress(OSError):
                connection.peer.shutdown(socket.SHUT_WR)
            self._end(connection)
            return
        connection.unsent = connection.unsent[connection.peer.send(connection.unsent) :]
        if self._is_for_downloads:
            connection.end_s = time.monotonic() + self._timeout_for_s

    def _pieces(self, request: bytes) -> Generator[bytes, None, None]:
        """Yield the bytes of a response, which is never empty."""
        method, _, rest = request.partition(b" ")
        path = rest.split(maxsplit=1)[0].partition(b"?")[0].decode(errors="replace") if rest.split() else ""
        if method not in (b"GET", b"HEAD"):
            answer = Answer("405 Method Not Allowed")
        else:
            try:
                answer = self._answer(path)
            except Exception:  # a source of the answer failed; the process itself continues
                log.exception("request failed server=%s", self._thread.name)
                answer = Answer("500 Internal Server Error")
        size = len(answer.body) if isinstance(answer.body, bytes) else answer.body.stat().st_size
        head = f"HTTP/1.1 {answer.status}\r\nContent-Type: {answer.content_type}\r\nContent-Length: {size}\r\n"
        yield head.encode() + b"Connection: close\r\n\r\n"
        if method == b"HEAD":
            return
        if isinstance(answer.body, bytes):
            yield answer.body
            return
        with answer.body.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                yield piece

    def _end(self, connection: _Connection) -> None:
        del self._connections[connection.peer.fileno()]
        self._selector.unregister(connection.peer)
        connection.peer.close()
        if connection.pieces is not None:
            connection.pieces.close()


def _awaited(error: OSError) -> int:
    """Return the event after which TLS goes on; 0: the connection has ended."""
    import ssl

    if isinstance(error, ssl.SSLWantReadError):
        return selectors.EVENT_READ
    return selectors.EVENT_WRITE if isinstance(error, ssl.SSLWantWriteError) else 0
