"""HTTP server for a few small purposes: scrapes and probes of a node, and the software of a site.

I/O. Source: RFC 9112 (HTTP/1.1), sections 2 and 9.6: one response, then the connection closes. Anyone may connect, so
everything is bounded: concurrent connections, seconds of a connection, connections per second, bytes of a request.
Neither threads nor descriptors grow with the number of connections.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from gdp.intervals import Rate
from gdp.token_bucket import TokenBucket

if TYPE_CHECKING:
    import ssl  # most nodes serve without TLS

log = logging.getLogger(__name__)

_READ_BYTES: Final = 8 * 1024
_ACCEPTS_RATE: Final = Rate(500.0, burst=500.0)  # 20 to 400 us each, including the kernel's share
_BURST: Final = 64  # connections accepted before open ones are served
_REQUEST_MAX_BYTES: Final = 8 * 1024
_PIECE_BYTES: Final = 1 << 18
_END: Final = (b"\r\n\r\n", b"\n\n")


class Answer(NamedTuple):
    """A response; a path stands for the content of that file."""

    status: str
    body: bytes | Path = b""
    content_type: str = "application/octet-stream"


@dataclass(slots=True, kw_only=True)
class _Connection:
    """One request and its response; it ends at ``end_s`` at the latest.

    Args:
        host: address of the peer.
        pieces: the response, once the request is complete.
    """

    peer: socket.socket
    host: str
    end_s: float
    request: bytearray = field(default_factory=bytearray)
    pieces: Generator[bytes, None, None] | None = None
    unsent: memoryview = field(default_factory=lambda: memoryview(b""))


class HttpServer:
    """Server of GET and HEAD on a listening socket, which it owns, in one thread until ``close``.

    Args:
        answer: returns the response for a path without its query; called in the server's thread, once for each request.
        is_for_downloads: whether the time of a connection begins again with each piece that is sent, and the oldest
            connection without a response under way gives way to a new one; else one more closes at once.
        name: of its thread, and in its log.
        connections: at once.
        timeout_s: from the first byte of a connection to its end.
        tls: context of a server; None: no TLS.
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
        self._answer = answer
        self._is_for_downloads = is_for_downloads
        self._listener = listener
        self._connections_max = connections
        self._timeout_for_s = timeout_s
        self._tls = tls
        self._accepts = TokenBucket(*_ACCEPTS_RATE)
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

    def _yields(self, host: str) -> _Connection | None:
        idle = (each for each in self._connections.values() if each.pieces is None and self._is_for_downloads)
        oldest = next(idle, None)
        if oldest is None:
            level = logging.WARNING if self._is_for_downloads else logging.DEBUG
            log.log(level, "connection refused server=%s reason=too many host=%s", self._thread.name, host)
        return oldest

    def _respond(self, connection: _Connection) -> Generator[bytes, None, None] | None:
        if len(connection.request) > _REQUEST_MAX_BYTES:
            raise ConnectionAbortedError("the request is too long")
        if not any(end in connection.request for end in _END):
            return None
        return self._pieces(bytes(connection.request))

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

    def close(self) -> None:
        """End all connections, and return when the address is free again."""
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
            times = [each.end_s for each in self._connections.values()]
            times += [] if self._resume_s is None else [self._resume_s]
            for key, _ in self._selector.select(max(min(times) - time.monotonic(), 0.0) if times else None):
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

    def _accept(self) -> None:
        for _ in range(_BURST):
            now_s = time.monotonic()
            if self._accepts.left(now_s) < 1.0:
                self._pause(now_s)
                return
            try:
                peer, address = self._listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError as error:  # no descriptors left, which this thread cannot repair
                log.warning("connection not accepted server=%s reason=%s", self._thread.name, error.strerror)
                self._pause(now_s)
                return
            self._accepts.spend(now_s)
            host = address[0]
            if len(self._connections) >= self._connections_max:
                oldest = self._yields(host)
                if oldest is None:
                    peer.close()
                    continue
                self._end(oldest)
            peer.setblocking(False)
            if self._tls is not None:
                peer = self._tls.wrap_socket(peer, server_side=True, do_handshake_on_connect=False)
            end_s = now_s + self._timeout_for_s
            self._connections[peer.fileno()] = _Connection(peer=peer, host=host, end_s=end_s)
            self._selector.register(peer, selectors.EVENT_READ)

    def _pause(self, now_s: float) -> None:
        """Leave further connections in the kernel's queue for a moment."""
        self._selector.unregister(self._listener)
        self._resume_s = now_s + 10.0 / _ACCEPTS_RATE.per_s

    def _proceed(self, connection: _Connection) -> None:
        events = 0
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
                self._end(connection)
        if connection.peer.fileno() in self._connections:
            is_read = connection.pieces is None
            self._selector.modify(
                connection.peer, events or (selectors.EVENT_READ if is_read else selectors.EVENT_WRITE)
            )

    def _read(self, connection: _Connection) -> None:
        while connection.pieces is None:  # TLS may hold more than the kernel shows
            data = connection.peer.recv(_READ_BYTES)
            if not data:
                raise ConnectionResetError("the request is incomplete")
            connection.request += data
            connection.pieces = self._respond(connection)

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
