"""HTTP server for a few small purposes: scrapes and probes of a node, and the software of a site.

I/O. Source: RFC 9112 (HTTP/1.1), sections 2 and 9.6: one response, then the connection closes.
"""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from gdp.request_server import Connection, RequestServer

if TYPE_CHECKING:
    import ssl  # most nodes serve without TLS

__all__ = ["Answer", "HttpServer"]

log = logging.getLogger(__name__)

_REQUEST_MAX_BYTES: Final = 8 * 1024
_PIECE_BYTES: Final = 1 << 18
_END: Final = (b"\r\n\r\n", b"\n\n")


class Answer(NamedTuple):
    """A response; a path stands for the content of that file."""

    status: str
    body: bytes | Path = b""
    content_type: str = "application/octet-stream"


class HttpServer(RequestServer):
    """Server of GET and HEAD.

    Args:
        answer: returns the response for a path without its query; called in the server's thread, once for each request.
        is_for_downloads: whether the time of a connection begins again with each piece that is sent, and the oldest
            connection without a response under way gives way to a new one; else one more closes at once.
        listener, name, connections, timeout_s, tls: as of ``RequestServer``.
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
        super().__init__(listener, name=name, connections=connections, timeout_s=timeout_s, tls=tls)

    @property
    def port(self) -> int:
        """Return the port that the server listens on."""
        return int(self._listener.getsockname()[1])

    def _yields(self, host: str) -> Connection | None:
        idle = (each for each in self._connections.values() if each.pieces is None and self._is_for_downloads)
        oldest = next(idle, None)
        if oldest is None:
            level = logging.WARNING if self._is_for_downloads else logging.DEBUG
            log.log(level, "connection refused server=%s reason=too many host=%s", self._thread.name, host)
        return oldest

    def _respond(self, connection: Connection) -> Generator[bytes, None, None] | None:
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

    def _write(self, connection: Connection) -> None:
        super()._write(connection)
        if self._is_for_downloads:
            connection.end_s = time.monotonic() + self._timeout_for_s
