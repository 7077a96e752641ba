"""Control socket of a running node: a Unix socket of mode 0600 that serves ``control_protocol``.

I/O. All sockets of a server are in one epoll, whose descriptor becomes readable when one of them has work. A node
watches that descriptor in its loop; the supervisor of ``fog`` polls it in a thread. The server replaces the socket of a
dead process. A socket that accepts a connection belongs to a live process and stays.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import stat
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.errors import GdpError, LocalError
from gdp.intervals import IDLE_S, PROMPT_S
from gdp.names import Name
from gdp.ports.readiness import readable
from gdp.state.control_protocol import (
    LINE_MAX_BYTES,
    Command,
    ControlRequestError,
    LineBuffer,
    Respond,
    Response,
    decode_request,
    encode_response,
)

log = logging.getLogger(__name__)

CONTROL_SOCKET: Final = "control.sock"  # in the folder of a process without an identity
_MODE: Final = 0o600
_BACKLOG: Final = 8
_CONNECTIONS_MAX: Final = 16
_RECEIVE_BYTES: Final = 4_096
_TIMEVAL: Final = struct.Struct("@ll")


def _ask_nothing(_arguments: Mapping[str, object], _respond: Respond) -> None:
    raise LocalError("this process is no member and sends no diagnostic requests")


def _show_nothing(_arguments: Mapping[str, object]) -> Mapping[str, object]:
    raise LocalError("this process keeps no tables")


def _keep_no_journal(_arguments: Mapping[str, object]) -> Mapping[str, object]:
    raise LocalError("this node keeps no journal; set journal in its configuration, and start it again")


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlHandlers:
    """Actions of a node on request.

    Attributes:
        reload: read the configuration again; raises ``GdpError`` if the old one stays in use.
        status: return JSON fields about the node.
        drain: begin to drain; the node ends when it has drained, and then closes the server.
        snapshot: return what a live view shows of the node; ``topology``: the network as it knows it.
        is_drained: whether all work that the drain waited for was finished; called once, at the end.
        topics: return JSON fields about the names that the node carries; None: it carries none.
        lookup: return JSON fields about a name, as far as known now; None: the node asks no RIB and is none.
        ask: send a diagnostic request, and call back once, at once or later; raises ``GdpError`` if it is not sent.
        show: return a page of a table; raises ``GdpError`` if there is no such table.
        incident: return a page of the journal; raises ``GdpError`` if the node keeps none.
    """

    status: Callable[[], Mapping[str, object]]
    reload: Callable[[], None] = lambda: None
    drain: Callable[[], None] = lambda: None
    is_drained: Callable[[], bool] = lambda: True
    topics: Callable[[], Mapping[str, object]] | None = None
    lookup: Callable[[Name], Mapping[str, object]] | None = None
    ask: Callable[[Mapping[str, object], Respond], None] = _ask_nothing
    show: Callable[[Mapping[str, object]], Mapping[str, object]] = _show_nothing
    incident: Callable[[Mapping[str, object]], Mapping[str, object]] = _keep_no_journal
    snapshot: Callable[[], Mapping[str, object]] = dict
    topology: Callable[[], Mapping[str, object]] = dict


@dataclass(slots=True)
class _Client:
    peer: socket.socket
    since_s: float
    lines: LineBuffer = field(default_factory=lambda: LineBuffer(LINE_MAX_BYTES))
    awaits_drain: bool = False


class ControlServer:
    """Server of one control socket.

    Args:
        path: of the socket; its folder must exist.
        handlers: called from ``handle_events``.

    Raises:
        LocalError: a live process listens there, another kind of file is there, or the system refuses.
    """

    def __init__(self, path: Path, handlers: ControlHandlers) -> None:
        self._path = path
        self._handlers = handlers
        self._clients: dict[int, _Client] = {}
        self._is_draining = False
        self._listener = _bind(path)
        self._inode = path.lstat().st_ino
        self._epoll = select.epoll()
        self._epoll.register(self._listener.fileno(), select.EPOLLIN)

    def fileno(self) -> int:
        """Return a descriptor that is readable when ``handle_events`` has work."""
        return self._epoll.fileno()

    def handle_events(self) -> None:
        """Accept connections and respond to requests; never blocks."""
        for fd, _ in self._epoll.poll(0.0):
            if fd == self._listener.fileno():
                self._accept()
            elif fd in self._clients:
                self._handle_readable(self._clients[fd])

    def close(self) -> None:
        """Report the end of a drain to the clients that wait for it, and remove the socket."""
        with contextlib.suppress(FileNotFoundError):
            if self._path.lstat().st_ino == self._inode:
                self._path.unlink()
        for client in list(self._clients.values()):
            if client.awaits_drain:
                result = {"state": "drained", "complete": self._handlers.is_drained()}
                self._respond(client, Response(result))
        for client in list(self._clients.values()):
            self._end(client)
        self._epoll.close()
        self._listener.close()

    def _accept(self) -> None:
        try:
            peer, _ = self._listener.accept()
        except OSError:  # the client has already closed the connection
            return
        peer.setblocking(False)
        now_s = time.monotonic()
        if len(self._clients) >= _CONNECTIONS_MAX and not self._end_oldest_idle(now_s):
            peer.close()
            return
        self._clients[peer.fileno()] = _Client(peer, now_s)
        self._epoll.register(peer.fileno(), select.EPOLLIN)

    def _end_oldest_idle(self, now_s: float) -> bool:
        idle = [each for each in self._clients.values() if not each.awaits_drain and now_s - each.since_s >= IDLE_S]
        for client in idle[:1]:
            self._end(client)
        return bool(idle)

    def _handle_readable(self, client: _Client) -> None:
        try:
            data = client.peer.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._end(client)
            return
        try:
            lines = client.lines.receive_bytes(data)
        except ControlRequestError as error:
            self._respond(client, Response(error=str(error)))
            self._end(client)
            return
        client.since_s = time.monotonic()
        for line in lines:
            response = self._handle(client, line)
            if response is not None:
                self._respond(client, response)

    def _handle(self, client: _Client, line: bytes) -> Response | None:
        """Return the response to a request; None: it comes later."""
        try:
            request = decode_request(line)
            command = request.command
            level = logging.INFO if command in (Command.RELOAD, Command.DRAIN) else logging.DEBUG
            log.log(level, "control command=%s", command.value)
            if command is Command.ASK:
                self._handlers.ask(request.arguments, lambda response: self._respond(client, response))
                return None
            if command is Command.SHOW:
                return Response(self._handlers.show(request.arguments))
            if command is Command.INCIDENT:
                return Response(self._handlers.incident(request.arguments))
            if command is Command.RELOAD:
                self._handlers.reload()
                return Response({"state": "reloaded"})
            if command is Command.STATUS:
                state = "draining" if self._is_draining else "running"
                return Response({"state": state, "pid": os.getpid(), **self._handlers.status()})
            if command is Command.TOPICS:
                if self._handlers.topics is None:
                    raise LocalError("this node carries no names; ask a switch or a proxy")
                return Response(self._handlers.topics())
            if command is Command.LOOKUP and request.name is not None:
                if self._handlers.lookup is None:
                    raise LocalError("this node asks no RIB; ask a switch or a RIB")
                return Response(self._handlers.lookup(request.name))
            if command is Command.SNAPSHOT:
                return Response({"pid": os.getpid(), **self._handlers.snapshot()})
            if command is Command.TOPOLOGY:
                return Response(self._handlers.topology())
            client.awaits_drain = True
            if not self._is_draining:
                self._is_draining = True
                self._handlers.drain()
            return Response({"state": "draining"})
        except GdpError as error:
            return Response(error=str(error) or type(error).__name__)

    def _respond(self, client: _Client, response: Response) -> None:
        if client.peer.fileno() < 0:  # the client did not read an earlier response
            return
        try:
            line = encode_response(response)
        except LocalError as error:
            line = encode_response(Response(error=str(error)))
        try:
            sent = client.peer.send(line)
        except OSError:
            sent = 0
        if sent < len(line):  # the client does not read, or has closed the connection
            self._end(client)

    def _end(self, client: _Client) -> None:
        if self._clients.pop(client.peer.fileno(), None) is not None:
            self._epoll.unregister(client.peer.fileno())
            client.peer.close()


@contextlib.contextmanager
def serve_control_in_thread(path: Path, handlers: ControlHandlers) -> Iterator[ControlServer]:
    """Serve a control socket in a thread while within; the handlers are called from that thread.

    Raises:
        LocalError: as for ``ControlServer``.
    """
    server = ControlServer(path, handlers)
    ended, waking = socket.socketpair()

    def serve() -> None:
        """Handle events until the context ends."""
        while ended.fileno() not in readable([server.fileno(), ended.fileno()]):
            server.handle_events()

    thread = threading.Thread(target=serve, name="control", daemon=True)
    thread.start()
    try:
        yield server
    finally:
        waking.send(b"\0")
        thread.join()
        server.close()
        ended.close()
        waking.close()


def connect_control(path: Path, timeout_s: float) -> socket.socket:
    """Return a socket that is connected to a control socket.

    Raises:
        OSError: the socket does not exist, no process listens, or this user may not connect.
    """
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # A non-blocking connect would fail while the node has other connections to accept; unix(7), SO_SNDTIMEO.
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(int(timeout_s), int(timeout_s % 1 * 1e6)))
        with short_path(path) as short:
            made.connect(short)
        made.settimeout(timeout_s)
    except BlockingIOError as error:
        made.close()
        raise TimeoutError(errno.ETIMEDOUT, "the node accepts no connection") from error
    except BaseException:
        made.close()
        raise
    return made


def _bind(path: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        _remove_stale(path)
        with short_path(path) as short:
            made.bind(short)
        path.chmod(_MODE)  # before listen: until then no process can connect
        made.listen(_BACKLOG)
        made.setblocking(False)
    except OSError as error:
        made.close()
        raise LocalError(f"{path}: the control socket cannot be made: {error.strerror}") from error
    except BaseException:
        made.close()
        raise
    return made


def _remove_stale(path: Path) -> None:
    """Remove the socket of a dead process.

    Raises:
        LocalError: a live process listens there, or the file is not a socket.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise LocalError(f"{path} exists and is no socket; remove it, or name another control_socket")
    try:
        connect_control(path, PROMPT_S).close()
    except TimeoutError:  # the process is alive, but busy
        pass
    except OSError as error:
        if error.errno not in (errno.ECONNREFUSED, errno.ENOENT):
            raise
        path.unlink(missing_ok=True)
        return
    raise LocalError(f"{path}: a running process has this control socket; stop it, or name another control_socket")


@contextlib.contextmanager
def short_path(path: Path) -> Iterator[str]:
    """Yield a path of at most 107 bytes, the limit of unix(7), that leads to ``path``."""
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)
