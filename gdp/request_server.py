"""Server of one request and one response a connection, in one thread; a subclass knows the protocol.

I/O. Anyone may connect, so everything is bounded: concurrent connections, seconds of a connection, connections per
second, and, by the subclass, bytes of a request. Neither threads nor descriptors grow with the number of connections.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from gdp.token_bucket import TokenBucket

if TYPE_CHECKING:
    import ssl  # most nodes serve without TLS

__all__ = ["Connection", "RequestServer"]

log = logging.getLogger(__name__)

_READ_BYTES: Final = 8 * 1024
_ACCEPTS_PER_S: Final = 500.0  # 20 to 400 us each, including the kernel's share
_BURST: Final = 64  # connections accepted before open ones are served


@dataclass(slots=True, kw_only=True)
class Connection:
    """One request and its response; it ends at ``end_s`` at the latest.

    Args:
        host: address of the peer; empty on a Unix socket.
        size: bytes of the whole request, where its beginning states them; None: unknown.
        pieces: the response, once the request is complete.
    """

    peer: socket.socket
    host: str
    end_s: float
    size: int | None = None
    request: bytearray = field(default_factory=bytearray)
    pieces: Generator[bytes, None, None] | None = None
    unsent: memoryview = field(default_factory=lambda: memoryview(b""))


class RequestServer(ABC):
    """Server on a listening socket, which it owns, until ``close``.

    Args:
        name: of its thread, and in its log.
        connections: at once.
        timeout_s: from the first byte of a connection to its end.
        tls: context of a server; None: no TLS.
    """

    def __init__(
        self,
        listener: socket.socket,
        *,
        name: str,
        connections: int,
        timeout_s: float,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._listener = listener
        self._connections_max = connections
        self._timeout_for_s = timeout_s
        self._tls = tls
        self._accepts = TokenBucket(_ACCEPTS_PER_S, _ACCEPTS_PER_S)
        self._connections: dict[int, Connection] = {}  # the oldest first
        self._resume_s: float | None = None  # when the server accepts connections again
        self._is_closed = False
        self._listener.setblocking(False)
        self._woken, self._wakes = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    @abstractmethod
    def _respond(self, connection: Connection) -> Generator[bytes, None, None] | None:
        """Return the response to what a connection has sent; None: the request is incomplete.

        Raises:
            OSError: the request gets no response.
        """

    @abstractmethod
    def _yields(self, host: str) -> Connection | None:
        """Return the connection that ends for a new one of ``host``, where all are taken; None: the new one ends."""

    def _is_full(self, host: str) -> bool:
        """Return whether one connection must end before another one of ``host`` is served."""
        del host
        return len(self._connections) >= self._connections_max

    def _handle_timer(self, now_s: float) -> float | None:
        """Do what is due apart from the connections; return when to be called next, or None."""
        del now_s
        return None

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
        timer_s = self._handle_timer(time.monotonic())
        while not self._is_closed:
            times = [each.end_s for each in self._connections.values()]
            times += [each for each in (self._resume_s, timer_s) if each is not None]
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
            if timer_s is not None and timer_s <= now_s:
                timer_s = self._handle_timer(now_s)

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
            host = address[0] if isinstance(address, tuple) else ""
            if self._is_full(host):
                oldest = self._yields(host)
                if oldest is None:
                    peer.close()
                    continue
                self._end(oldest)
            peer.setblocking(False)
            if self._tls is not None:
                peer = self._tls.wrap_socket(peer, server_side=True, do_handshake_on_connect=False)
            end_s = now_s + self._timeout_for_s
            self._connections[peer.fileno()] = Connection(peer=peer, host=host, end_s=end_s)
            self._selector.register(peer, selectors.EVENT_READ)

    def _pause(self, now_s: float) -> None:
        """Leave further connections in the kernel's queue for a moment."""
        self._selector.unregister(self._listener)
        self._resume_s = now_s + 10.0 / _ACCEPTS_PER_S

    def _proceed(self, connection: Connection) -> None:
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

    def _read(self, connection: Connection) -> None:
        while connection.pieces is None:  # TLS may hold more than the kernel shows
            data = connection.peer.recv(_READ_BYTES)
            if not data:
                raise ConnectionResetError("the request is incomplete")
            connection.request += data
            connection.pieces = self._respond(connection)

    def _write(self, connection: Connection) -> None:
        assert connection.pieces is not None
        connection.unsent = connection.unsent or memoryview(next(connection.pieces, b""))
        if not connection.unsent:
            with contextlib.suppress(OSError):
                connection.peer.shutdown(socket.SHUT_WR)
            self._end(connection)
            return
        connection.unsent = connection.unsent[connection.peer.send(connection.unsent) :]

    def _end(self, connection: Connection) -> None:
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
