"""Server of the live view: the page's files and a WebSocket, on the loopback address, behind a token in the URL.

I/O. Every local user may connect, so nothing is served without the token, and pages are bounded. A page may load from
its own origin alone (Content-Security-Policy, level 3). A page that reads slowly gets the newest figures, not all.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from importlib.resources import files
from typing import TYPE_CHECKING, Final

import orjson

from gdp.access_token import is_access_token, new_access_token
from gdp.errors import LocalError
from gdp.extras import require_extra
from gdp_extensions.dashboard.core.scene import Scene
from gdp_extensions.dashboard.poller import Poller

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

log = logging.getLogger(__name__)

POLL_S: Final = 0.75  # with the time of a poll, a change is on the page within a second
CLIENTS_MAX: Final = 8
_LOOPBACK: Final = "127.0.0.1"
_REQUEST_MAX_BYTES: Final = 4_096
_TRY_AGAIN: Final = 1013  # close code of the IANA registry
_TYPES: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self';"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Connection": "close",
}


def page_files() -> dict[str, tuple[str, bytes]]:
    """Return the page's files by name: media type and bytes."""
    found = {}
    for each in files("gdp_extensions.dashboard").joinpath("page").iterdir():
        suffix = each.name[each.name.rfind(".") :]
        if suffix in _TYPES:
            found[each.name] = (_TYPES[suffix], each.read_bytes())
    return found


class DashboardServer:
    """Live view of the nodes that a poller reads.

    Args:
        port: of 127.0.0.1; 0: the system chooses.
        token: in the URL; by default a new one.

    Raises:
        LocalError: the port is in use, or ``websockets`` is not installed.
    """

    def __init__(self, poller: Poller, port: int = 0, token: str | None = None, poll_s: float = POLL_S) -> None:
        require_extra("dashboard", ["websockets"], "gdp dashboard")
        self.scene = Scene()
        self._poller = poller
        self._poll_s = poll_s
        self._token = new_access_token() if token is None else token
        self._files = page_files()
        self._clients = 0
        self._polled = asyncio.Condition()
        try:
            self._socket = socket.create_server((_LOOPBACK, port))
        except OSError as error:
            raise LocalError(f"port {port}: {error.strerror}; choose another one with --port") from error

    @property
    def port(self) -> int:
        """Return the port."""
        return int(self._socket.getsockname()[1])

    @property
    def url(self) -> str:
        """Return the address of the page, with its token."""
        return f"http://{_LOOPBACK}:{self.port}/{self._token}/"

    async def run_until(self, ready: Callable[[], None], stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set; ``ready`` is called after the first poll."""
        from websockets.asyncio.server import serve

        await self._poll()
        polling = asyncio.create_task(self._poll_for_ever())
        waiting = asyncio.create_task(stop.wait())
        try:
            async with serve(
                self._attend,
                sock=self._socket,
                process_request=self._respond,
                compression=None,
                max_size=_REQUEST_MAX_BYTES,
                server_header=None,
            ):
                ready()
                done, _ = await asyncio.wait((polling, waiting), return_when=asyncio.FIRST_COMPLETED)
                if polling in done:
                    polling.result()  # raises what ended it
        finally:
            for task in (polling, waiting):
                task.cancel()
            await asyncio.gather(polling, waiting, return_exceptions=True)
            self._poller.close()

    async def _poll(self) -> None:
        readings = await self._poller.read_nodes()
        self.scene.update(readings, time.monotonic(), time.time())
        async with self._polled:
            self._polled.notify_all()

    async def _poll_for_ever(self) -> None:
        due_s = time.monotonic() + self._poll_s
        while True:
            await asyncio.sleep(max(due_s - time.monotonic(), 0.0))
            due_s = max(due_s + self._poll_s, time.monotonic())
            await self._poll()

    def _respond(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a file or a refusal; None: the request opens the WebSocket."""
        host = f"{_LOOPBACK}:{self.port}"
        if request.headers.get("Host") not in (host, f"localhost:{self.port}"):
            return _response(connection, HTTPStatus.FORBIDDEN)  # a name that points here: DNS rebinding
        token, _, name = request.path.removeprefix("/").partition("/")
        if not is_access_token(token, self._token):
            return _response(connection, HTTPStatus.NOT_FOUND)
        if name == "live":
            origin = request.headers.get("Origin")
            is_own = origin is None or origin in (f"http://{host}", f"http://localhost:{self.port}")
            return None if is_own else _response(connection, HTTPStatus.FORBIDDEN)
        found = self._files.get(name or "index.html")
        if found is None:
            return _response(connection, HTTPStatus.NOT_FOUND)
        return _response(connection, HTTPStatus.OK, *found)

    async def _attend(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        if self._clients >= CLIENTS_MAX:
            await connection.close(_TRY_AGAIN, f"{CLIENTS_MAX} pages are open already")
            return
        self._clients += 1
        page = _Page(connection, self.scene)
        sender = asyncio.create_task(self._send(page))
        try:
            async for data in connection:
                await page.handle(data)
        except ConnectionClosed as error:
            log.debug("page gone reason=%s", error)
        finally:
            self._clients -= 1
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)

    async def _send(self, page: _Page) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):  # the reader of the connection ends, too
            while True:
                await page.send_news()
                async with self._polled:
                    await self._polled.wait()


class _Page:
    """One open page: what it has, and which name it follows."""

    def __init__(self, connection: ServerConnection, scene: Scene) -> None:
        self._connection = connection
        self._scene = scene
        self._version = -1
        self._event = 0
        self._name = ""
        self._series: tuple[str, ...] = ()

    async def send_news(self) -> None:
        """Send the structure if it changed, then the figures, and what the page follows."""
        scene = self._scene
        if scene.version != self._version:
            self._version = scene.version
            await self._put(scene.structure())
        figures = scene.figures(self._event)
        events = figures["events"]
        if isinstance(events, list) and events:
            self._event = events[-1]["number"]
        await self._put(figures)
        if self._name:
            await self._put(scene.name_detail(self._name))

    async def handle(self, data: str | bytes) -> None:
        """Answer what a page wants: ``{"name": ID}`` to follow, or ``{"history": [KEY, ...]}``."""
        try:
            fields = json.loads(data)
        except ValueError:
            log.info("request of a page not read bytes=%d", len(data))
            return
        if not isinstance(fields, dict):
            return
        if isinstance(name := fields.get("name"), str):
            self._name = name
            await self._put(self._scene.name_detail(name))
        if isinstance(keys := fields.get("history"), list):
            for key in keys[:_SERIES_AT_ONCE]:
                await self._put(self._scene.history(str(key)))

    async def _put(self, message: Mapping[str, object]) -> None:
        await self._connection.send(orjson.dumps(message).decode())


_SERIES_AT_ONCE: Final = 16


def _response(
    connection: ServerConnection, status: HTTPStatus, media_type: str = "text/plain", body: bytes | None = None
) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    del connection
    content = f"{status.phrase}\n".encode() if body is None else body
    headers = Headers(_HEADERS)
    headers["Content-Type"] = f"{media_type}; charset=utf-8"
    headers["Content-Length"] = str(len(content))
    return Response(status.value, status.phrase, headers, content)
