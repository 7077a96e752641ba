"""Listening socket for enrolment, in one thread: TCP, or a Unix socket for machines of this host.

I/O. Any host may connect, so everything is bounded: concurrent connections in total and per address, bytes, seconds,
and connections a second. A connection is closed at its first wrong byte. When the limit of connections is reached, the
oldest one is closed, so idle connections do not exclude machines.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fog.bootstrap.responder import Responder
from gdp.errors import GdpError, LocalError, StatementError
from gdp.ports.listening import listen_tcp
from gdp.token_bucket import TokenBucket
from gdp.trust.bootstrap_ticket import REQUEST_MAX_BYTES, request_head

__all__ = ["ACCEPTS_PER_S", "CONNECTIONS_MAX", "CONNECTION_S", "Listener", "bind_tcp", "bind_unix"]

log = logging.getLogger(__name__)

CONNECTIONS_MAX: Final = 64
CONNECTION_S: Final = 5.0  # total lifetime of a connection, whatever the peer's speed
ACCEPTS_PER_S: Final = 500.0  # about 0.4 ms each, including the kernel's share
_EACH_MAX: Final = 16  # connections per address
_BACKLOG: Final = 128
_BURST: Final = 64  # connections accepted before open ones are served
_FLUSH_S: Final = 60.0


@dataclass(slots=True, kw_only=True)
class _Connection:
    peer: socket.socket
    host: str
    end_s: float
    size: int | None = None  # bytes of the whole request, known after its header
    request: bytearray = field(default_factory=bytearray)
    answer: memoryview = field(default_factory=lambda: memoryview(b""))


def bind_tcp(host: str, port: int) -> socket.socket:
    """Return a listening socket; an empty host: all addresses.

    Raises:
        LocalError: the port is taken, or the address is not this host's.
    """
    try:
        return listen_tcp(host, port)
    except OSError as error:
        raise LocalError(f"enrolment: listen on {host or '*'}:{port}: {error.strerror or error}") from error


def bind_unix(path: Path) -> socket.socket:
    """Return a listening socket at a path and replace an existing one; the folder's permissions control access.

    Raises:
        LocalError: the system refuses.
    """
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            path.unlink(missing_ok=True)
            made.bind(f"/proc/self/fd/{folder}/{path.name}")  # a socket's path has at most 107 bytes
        finally:
            os.close(folder)
        made.listen(_BACKLOG)
    except OSError as error:
        made.close()
        raise LocalError(f"{path}: {error.strerror}") from error
    return made


class Listener:
    """Server that passes complete requests to a responder; ``close`` closes its listening socket too."""

    def __init__(self, listening: socket.socket, responder: Responder) -> None:
        self._listening = listening
        self._responder = responder
        self._connections: dict[int, _Connection] = {}  # oldest first
        self._accepts = TokenBucket(ACCEPTS_PER_S, ACCEPTS_PER_S)
        self._resume_s: float | None = None  # time at which accepting resumes
        self._flush_s = 0.0
        self._is_closed = False
        listening.setblocking(False)
        self._woken, self._wakes = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(listening, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name="enrolment", daemon=True)
        self._thread.start()

    @property
    def address(self) -> object:
        """Return the listening address as the socket reports it."""
        return self._listening.getsockname()

    def close(self) -> None:
        """Close all connections, and return when the address is free again."""
        self._is_closed = True
        self._wakes.send(b"x")
        self._thread.join()
        for connection in list(self._connections.values()):
            self._end(connection)
        self._selector.close()
        for each in (self._listening, self._woken, self._wakes):
            each.close()

    def _serve(self) -> None:
        while not self._is_closed:
            for key, events in self._selector.select(self._timeout_s()):
                if key.fileobj is self._listening:
                    self._accept()
                elif key.fd in self._connections:
                    self._proceed(self._connections[key.fd], events)
            now_s = time.monotonic()
            for connection in [each for each in self._connections.values() if each.end_s <= now_s]:
                self._end(connection)
            if self._resume_s is not None and self._resume_s <= now_s:
                self._resume_s = None
                self._selector.register(self._listening, selectors.EVENT_READ)
            if now_s >= self._flush_s:
                self._flush_s = now_s + _FLUSH_S
                with _reported("audit log"):
                    self._responder.flush()

    def _timeout_s(self) -> float:
        ends = [each.end_s for each in self._connections.values()]
        ends += [] if self._resume_s is None else [self._resume_s]
        return max(min([*ends, self._flush_s]) - time.monotonic(), 0.0)

    def _accept(self) -> None:
        for _ in range(_BURST):
            now_s = time.monotonic()
            if self._accepts.left(now_s) < 1.0:
                self._pause(now_s)
                return
            try:
                peer, address = self._listening.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError as error:  # no descriptors are left, which this thread cannot repair
                log.warning("enrolment not accepted reason=%s", error.strerror)
                self._pause(now_s)
                return
            self._accepts.spend(now_s)
            host = address[0] if isinstance(address, tuple) else ""
            same = [each for each in self._connections.values() if each.host == host] if host else []
            if len(same) >= _EACH_MAX:
                self._end(same[0])
            elif len(self._connections) >= CONNECTIONS_MAX:
                self._end(next(iter(self._connections.values())))
            peer.setblocking(False)
            self._connections[peer.fileno()] = _Connection(peer=peer, host=host, end_s=now_s + CONNECTION_S)
            self._selector.register(peer, selectors.EVENT_READ)

    def _pause(self, now_s: float) -> None:
        """Leave further connections in the kernel's queue for a moment."""
        self._selector.unregister(self._listening)
        self._resume_s = now_s + 10.0 / ACCEPTS_PER_S

    def _proceed(self, connection: _Connection, events: int) -> None:
        try:
            if events & selectors.EVENT_WRITE:
                self._write(connection)
            elif events & selectors.EVENT_READ:
                self._read(connection)
        except BlockingIOError:
            return
        except OSError:  # the peer has closed
            self._end(connection)

    def _read(self, connection: _Connection) -> None:
        data = connection.peer.recv(REQUEST_MAX_BYTES)
        connection.request += data
        answer: bytes | None = b""
        if data:
            with _reported("request"):
                answer = self._answer_to(connection)
        if answer is None:
            return
        if not answer:
            self._end(connection)
            return
        connection.answer = memoryview(answer)
        self._selector.modify(connection.peer, selectors.EVENT_WRITE)

    def _answer_to(self, connection: _Connection) -> bytes | None:
        """Return the response to a connection; empty: no response; None: the request is incomplete."""
        if connection.size is None:
            try:
                head = request_head(bytes(connection.request))
            except StatementError:
                return b""
            if head is None:
                return None
            if not self._responder.is_expected(head[0]):
                return b""
            connection.size = head[1]
        if len(connection.request) < connection.size:
            return None
        answer = self._responder.answer(bytes(connection.request), time.time())
        self._responder.flush()
        return answer

    def _write(self, connection: _Connection) -> None:
        connection.answer = connection.answer[connection.peer.send(connection.answer) :]
        if not connection.answer:
            with contextlib.suppress(OSError):
                connection.peer.shutdown(socket.SHUT_WR)
            self._end(connection)

    def _end(self, connection: _Connection) -> None:
        del self._connections[connection.peer.fileno()]
        self._selector.unregister(connection.peer)
        connection.peer.close()


@contextmanager
def _reported(what: str) -> Iterator[None]:
    """Log an error and keep the thread alive; the machine sends its request again."""
    try:
        yield
    except GdpError as error:
        log.error("enrolment failed at=%s reason=%s", what, error)
    except Exception:  # an internal error ends one request, not the thread that serves all machines
        log.exception("enrolment failed at=%s", what)
