"""Listening socket for enrolment: TCP, or a Unix socket for machines of this host.

I/O. Any host may connect, so connections are bounded, in total and per address. A connection is closed at its first
wrong byte. When a limit is reached, the oldest one is closed, so idle connections do not exclude machines.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from fog.bootstrap.responder import Responder
from gdp.errors import GdpError, LocalError, StatementError
from gdp.ports.listening import listen_tcp
from gdp.request_server import Connection, RequestServer
from gdp.trust.bootstrap_ticket import request_head

__all__ = ["CONNECTIONS_MAX", "CONNECTION_S", "Listener", "bind_tcp", "bind_unix"]

log = logging.getLogger(__name__)

CONNECTIONS_MAX: Final = 64
CONNECTION_S: Final = 5.0  # total lifetime of a connection, whatever the peer's speed
_EACH_MAX: Final = 16  # connections per address
_BACKLOG: Final = 128
_FLUSH_S: Final = 60.0


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


class Listener(RequestServer):
    """Server that passes complete requests to a responder."""

    def __init__(self, listening: socket.socket, responder: Responder) -> None:
        self._responder = responder
        super().__init__(listening, name="enrolment", connections=CONNECTIONS_MAX, timeout_s=CONNECTION_S)

    @property
    def address(self) -> object:
        """Return the listening address as the socket reports it."""
        return self._listener.getsockname()

    def _of(self, host: str) -> list[Connection]:
        return [each for each in self._connections.values() if each.host == host] if host else []

    def _is_full(self, host: str) -> bool:
        return super()._is_full(host) or len(self._of(host)) >= _EACH_MAX

    def _yields(self, host: str) -> Connection | None:
        same = self._of(host)
        return same[0] if len(same) >= _EACH_MAX else next(iter(self._connections.values()))

    def _handle_timer(self, now_s: float) -> float | None:
        with _reported("audit log"):
            self._responder.flush()
        return now_s + _FLUSH_S

    def _respond(self, connection: Connection) -> Generator[bytes, None, None] | None:
        answer: bytes | None = b""
        with _reported("request"):
            answer = self._answer_to(connection)
        if answer == b"":
            raise ConnectionAbortedError("the request gets no response")
        return None if answer is None else (piece for piece in (answer,))

    def _answer_to(self, connection: Connection) -> bytes | None:
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


@contextmanager
def _reported(what: str) -> Iterator[None]:
    """Log an error and keep the thread alive; the machine sends its request again."""
    try:
        yield
    except GdpError as error:
        log.error("enrolment failed at=%s reason=%s", what, error)
    except Exception:  # an internal error ends one request, not the thread that serves all machines
        log.exception("enrolment failed at=%s", what)
