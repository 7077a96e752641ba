"""Enrolment server: accepts TLS connections of joiners and members, bounded in number, rate, size and time.

I/O. Any host may connect; a Unix socket is for machines of this host, which share no address. A stranger's whole
connection lasts at most ``STRANGER_S``; where too many strangers are connected, the oldest one is closed. The desk's
work runs in one thread, so that a slow disk delays no handshake.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import os
import socket
import threading
import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

from gdp.crypto.schema import OCTETS, Keyed, number, text
from gdp.enrolment.desk import EnrolmentDesk, MemberConnection, refusal_of
from gdp.enrolment.domain_files import HANDOVER_SOCKET, DomainFiles
from gdp.enrolment.registry import Registry
from gdp.enrolment.server_tls import ServerTls, make_server_tls
from gdp.errors import DropReason, GdpError, LocalError, StatementError
from gdp.intervals import DAY_S
from gdp.limits import ADDRESS_CONNECTIONS_RATE, CONNECTIONS_RATE
from gdp.management.control_socket import short_path
from gdp.ports.tcp_server import client_network, listen_tcp
from gdp.token_bucket import TokenBucket, TokenBuckets
from gdp.trust.enrolment_wire import (
    LENGTH_BYTES,
    NONCE_BYTES,
    REQUEST_MAX_BYTES,
    STRANGER_MAX_BYTES,
    EnrolmentError,
    Message,
    Refusal,
    encode_message,
    message_bytes,
    read_message,
)

log = logging.getLogger(__name__)

STRANGER_S: Final = 10.0
POLL_MAX_S: Final = 60.0
_STRANGERS_MAX: Final = 64
_BACKLOG: Final = 128
_EACH_MAX: Final = 16  # strangers from one address
_MEMBERS_MAX: Final = 4_096
_EACH_MEMBER_MAX: Final = 8  # connections of one machine
_LOOK_S: Final = 0.0005  # between connections above the share of their address, which cost no handshake
_FLUSH_S: Final = 10.0
_INSTANCES_MAX: Final = 16  # remembered starts of one machine's agent

_T = TypeVar("_T")


def bind_server(port: int, host: str = "") -> socket.socket:
    """Return a listening socket; an empty host: all addresses. Raises ``LocalError``: the port is taken."""
    try:
        return listen_tcp(host, port)
    except OSError as error:
        raise LocalError(
            f"enrolment server: TCP port {port} cannot be listened on: {error.strerror or error}; choose another one"
        ) from error


def bind_unix(path: Path, kind: socket.SocketKind) -> socket.socket:
    """Return a non-blocking socket at a path, in place of an earlier one, for this user alone; a stream listens.

    Raises:
        LocalError: the system refuses.
    """
    made = socket.socket(socket.AF_UNIX, kind)
    try:
        path.unlink(missing_ok=True)
        with short_path(path) as short:
            made.bind(short)
        path.chmod(0o600)
        made.setblocking(False)
        if kind is socket.SOCK_STREAM:
            made.listen(_BACKLOG)
    except OSError as error:
        made.close()
        raise LocalError(f"enrolment server: {path}: {error.strerror or error}") from error
    return made


@dataclass(slots=True, eq=False)
class _Connection:
    """One connection; ``session`` is set once its client has proved to be a member."""

    task: asyncio.Task[None] = field(init=False)
    peer: socket.socket
    host: bytes  # as of ``client_network``; empty: of this host, at a Unix socket
    session: MemberConnection | None = None
    is_attended: bool = False
    nonce: bytes = field(default_factory=lambda: os.urandom(NONCE_BYTES))


class EnrolmentServer:
    """Server of one domain.

    Args:
        make_tls: returns a fresh context; called at the start, and each day.
        handover: datagram socket of ``bind_unix``; None: no relay hands connections over.
    """

    def __init__(
        self,
        listening: socket.socket,
        desk: EnrolmentDesk,
        make_tls: Callable[[], ServerTls],
        handover: socket.socket | None = None,
    ) -> None:
        self._listening = listening
        self._handover = handover
        self._desk = desk
        self._make_tls = make_tls
        self._tls = make_tls()
        self._rate = TokenBucket(*CONNECTIONS_RATE)
        self._each = TokenBuckets(*ADDRESS_CONNECTIONS_RATE)
        self._strangers: OrderedDict[_Connection, None] = OrderedDict()
        self._members: dict[int, OrderedDict[_Connection, None]] = defaultdict(OrderedDict)
        self._polling: dict[int, OrderedDict[bytes, None]] = defaultdict(OrderedDict)  # instances, the newest last
        self._news: dict[bytes, set[asyncio.Event]] = defaultdict(set)  # of who polls, by its name
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="enrolment")

    async def accept_connections(self) -> None:
        """Serve until cancelled; then every connection and the listening socket are closed."""
        self._listening.setblocking(False)
        upkeep, loop = asyncio.ensure_future(self._keep_up()), asyncio.get_running_loop()
        if self._handover is not None:
            loop.add_reader(self._handover, self._take_handed, self._handover)
        try:
            while True:
                await self._accept()
        finally:
            self._listening.close()
            if self._handover is not None:
                loop.remove_reader(self._handover)
                self._handover.close()
            tasks = [upkeep, *(each.task for each in self._connections())]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._worker.shutdown()

    def _connections(self) -> list[_Connection]:
        return [*self._strangers, *(each for connections in self._members.values() for each in connections)]

    async def _accept(self) -> None:
        wait_s = (1.0 - self._rate.left(time.monotonic())) / CONNECTIONS_RATE.per_s
        if wait_s > 0:
            await asyncio.sleep(wait_s)  # further connections wait in the kernel's queue
        try:
            peer, address = await asyncio.get_running_loop().sock_accept(self._listening)
        except ConnectionAbortedError:
            return
        except OSError as error:  # no descriptors are left: others must end first
            log.warning("enrolment connection not accepted reason=%s", error.strerror)
            await asyncio.sleep(1.0)
            return
        host = client_network(str(address[0])) if isinstance(address, tuple) else b""
        if host and not self._each.spend(host, time.monotonic()):
            peer.close()
            await asyncio.sleep(_LOOK_S)
            return
        self._rate.charge(time.monotonic(), 1.0)
        self._begin(peer, host)

    def _take_handed(self, handover: socket.socket) -> None:
        """Serve a connection that the relay accepted, whose rate it limits."""
        try:
            _, descriptors, _, _ = socket.recv_fds(handover, 1, 1)
        except BlockingIOError:
            return
        for descriptor in descriptors:
            peer = socket.socket(fileno=descriptor)
            try:
                peer.setblocking(False)
                host = client_network(str(peer.getpeername()[0]))
            except OSError:  # it is gone
                peer.close()
                continue
            self._begin(peer, host)

    def _begin(self, peer: socket.socket, host: bytes) -> None:
        connection = _Connection(peer=peer, host=host)
        same = [each for each in self._strangers if host and each.host == host]
        if len(same) >= _EACH_MAX:
            same[0].task.cancel()
        elif len(self._strangers) >= _STRANGERS_MAX:
            next(iter(self._strangers)).task.cancel()
        self._strangers[connection] = None
        connection.task = asyncio.ensure_future(self._attend(connection))
        connection.task.add_done_callback(functools.partial(self._ended, connection))

    def _ended(self, connection: _Connection, task: asyncio.Task[None]) -> None:
        self._strangers.pop(connection, None)
        if not connection.is_attended:
            connection.peer.close()
        session = connection.session
        if session is not None:
            self._members[session.machine].pop(connection, None)
            if not self._members[session.machine]:
                del self._members[session.machine]
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("enrolment connection failed", exc_info=error)

    async def _attend(self, connection: _Connection) -> None:
        connection.is_attended = True  # from here on the transport closes the socket
        end_s = time.monotonic() + STRANGER_S
        reader = asyncio.StreamReader(limit=REQUEST_MAX_BYTES)
        protocol = asyncio.StreamReaderProtocol(reader)
        tls, loop = self._tls, asyncio.get_running_loop()
        try:
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, connection.peer, ssl=tls.context, ssl_handshake_timeout=STRANGER_S / 2
            )
        except OSError:  # no TLS, or the peer has closed
            return
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        try:
            await self._write(writer, await self._work(self._desk.greeting, connection.nonce, time.time()))
            while await self._serve_one(reader, writer, connection, tls.binding, end_s):
                pass
        except (OSError, asyncio.IncompleteReadError):  # gone, or too slow
            pass
        finally:
            await _close(writer)

    async def _serve_one(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        connection: _Connection,
        binding: bytes,
        end_s: float,
    ) -> bool:
        """Answer one request; return whether another one may follow."""
        idle_s = 2 * POLL_MAX_S if connection.session is not None else end_s - time.monotonic()
        try:
            with _cut_after(writer, idle_s):
                head = await reader.readexactly(LENGTH_BYTES)
            size = message_bytes(head, REQUEST_MAX_BYTES if connection.session else STRANGER_MAX_BYTES)
            with _cut_after(writer, min(STRANGER_S, idle_s)):
                fields = read_message(await reader.readexactly(size))
            response = await self._response(connection, fields, binding)
            goes_on = True
        except GdpError as error:
            refusal = refusal_of(error)
            if refusal is None or refusal["code"] == Refusal.UNAVAILABLE.value:
                log.error("enrolment request failed reason=%s", error)
            elif not isinstance(error, EnrolmentError) or connection.session is None:
                about = error.about if isinstance(error, EnrolmentError) else ""
                await self._work(self._desk.refused, f"{refusal['code']}", None, about)
            response = refusal or {"ok": False, "code": Refusal.UNAVAILABLE.value, "error": "try again later"}
            goes_on = connection.session is not None and not isinstance(error, StatementError)
        await self._write(writer, response)
        return goes_on

    async def _write(self, writer: asyncio.StreamWriter, fields: Mapping[str, object]) -> None:
        writer.write(encode_message(fields))
        with _cut_after(writer, STRANGER_S):
            await writer.drain()

    async def _response(self, connection: _Connection, fields: Message, binding: bytes) -> Mapping[str, object]:
        operation, now, desk = Keyed("op", text(16)).read(fields), time.time(), self._desk
        session = connection.session
        if operation == "join" and session is None:
            return await self._work(desk.join, fields, binding, connection.nonce, now)
        if operation == "member" and session is None:
            session = await self._work(desk.identify, fields, binding, connection.nonce, now)
            self._admit(connection, session)
            return {"ok": True}
        if session is None:
            raise StatementError(DropReason.MALFORMED, f"{operation!r} is no request of a stranger")
        match operation:
            case "poll":
                return await self._poll(connection, session, fields)
            case "install":
                await self._work(desk.install, session, fields, now)
                return {"ok": True}
            case "renew":
                return await self._work(desk.renew, session, fields, now)
            case "nodes":
                return await self._work(desk.nodes, session, fields, self._is_online)
            case "send":
                recipient = await self._work(desk.send, session, fields, now)
                for event in self._news.get(bytes(recipient), ()):
                    event.set()
                return {"ok": True}
            case "receive":
                return await self._work(desk.mail_page, session, fields)
        raise StatementError(DropReason.MALFORMED, f"{operation!r} is no request")

    def _admit(self, connection: _Connection, session: MemberConnection) -> None:
        """Count a connection as a member's, no longer as a stranger's."""
        is_new = session.machine not in self._members
        if is_new and len(self._members) >= _MEMBERS_MAX:
            raise EnrolmentError(Refusal.UNAVAILABLE, "too many members are connected")
        connections = self._members[session.machine]
        if len(connections) >= _EACH_MEMBER_MAX:
            next(iter(connections)).task.cancel()
        self._strangers.pop(connection, None)
        connections[connection] = None
        connection.session = session

    def _is_online(self, machine: int) -> bool:
        connections = list(self._members.get(machine, ()))
        current = next(reversed(self._polling[machine]), None) if machine in self._polling else None
        return any(each.session is not None and each.session.instance == current for each in connections)

    async def _poll(self, connection: _Connection, session: MemberConnection, fields: Message) -> Mapping[str, object]:
        """Answer once something differs from what the member knows, or after the time that it asks for."""
        await self._refuse_double(connection, session)
        known = Keyed("digest", OCTETS).read(fields)
        end_s = time.monotonic() + Keyed("wait_s", number(0, POLL_MAX_S)).read(fields)
        event, events = asyncio.Event(), self._news[bytes(session.name)]
        events.add(event)
        try:
            while True:
                event.clear()
                status, digest = await self._work(self._desk.status, session, time.time())
                left_s = end_s - time.monotonic()
                if digest != known or status["mail"] or left_s <= 0:
                    return status
                timer = asyncio.get_running_loop().call_later(left_s, event.set)
                try:
                    await event.wait()
                finally:
                    timer.cancel()
        finally:
            events.discard(event)
            if not events:
                self._news.pop(bytes(session.name), None)

    async def _refuse_double(self, connection: _Connection, session: MemberConnection) -> None:
        """Refuse an agent that comes back after another one replaced it: two machines run with one identity."""
        instances = self._polling[session.machine]
        newest = next(reversed(instances), None)
        if session.instance == newest:
            return
        if session.instance in instances:
            await self._work(self._desk.has_double, session)
            raise EnrolmentError(
                Refusal.TWO_MACHINES,
                "another machine runs with this machine's identity: remove it from the domain with gdp domain remove,"
                " and join each machine with a token of its own",
            )
        instances[session.instance] = None
        while len(instances) > _INSTANCES_MAX:
            instances.popitem(last=False)
        for each in list(self._members[session.machine]):
            if each is not connection and each.session is not None and each.session.instance == newest:
                each.task.cancel()

    async def _keep_up(self) -> None:
        """Write the audit log, and replace the certificate in time."""
        tls_s = time.monotonic() + DAY_S
        while True:
            await asyncio.sleep(_FLUSH_S)
            try:
                await self._work(self._desk.flush)
                if time.monotonic() >= tls_s:
                    self._tls = await self._work(self._make_tls)
                    tls_s = time.monotonic() + DAY_S
            except GdpError as error:
                log.error("enrolment upkeep failed reason=%s", error)

    async def _work(self, function: Callable[..., _T], *arguments: object) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._worker, functools.partial(function, *arguments))


@contextlib.contextmanager
def _cut_after(writer: asyncio.StreamWriter, after_s: float) -> Iterator[None]:
    """Cut the connection of a peer that is too slow. ``wait_for`` would lose a cancellation (CPython issue 86296)."""
    timer = asyncio.get_running_loop().call_later(after_s, writer.transport.abort)
    try:
        yield
    finally:
        timer.cancel()


async def _close(writer: asyncio.StreamWriter) -> None:
    """Send what is left and close; a peer that does not answer is cut off."""
    writer.close()
    try:
        await asyncio.wait_for(writer.wait_closed(), 1.0)
    except (OSError, asyncio.TimeoutError):
        pass
    finally:
        writer.transport.abort()


async def serve_domain(files: DomainFiles, listening: socket.socket) -> None:
    """Serve a domain until cancelled; the listening socket is closed then.

    Raises:
        LocalError: the domain's keys cannot be read, or its folders cannot be written.
        StoreError: the registry cannot be opened.
    """
    config, handover = files.config, None
    with contextlib.closing(listening), Registry(config.state) as registry:
        desk = EnrolmentDesk(files, registry)
        try:
            if config.switch is not None:
                handover = bind_unix(config.state / HANDOVER_SOCKET, socket.SOCK_DGRAM)
        except LocalError as error:
            log.warning("the relay's port does not enrol machines reason=%s", error)
        server = EnrolmentServer(
            listening, desk, lambda: make_server_tls(config.domain, config.state, time.time()), handover
        )
        try:
            await server.accept_connections()
        finally:
            desk.flush()


@contextlib.contextmanager
def serve_domain_in_thread(files: DomainFiles, listening: socket.socket) -> Iterator[None]:
    """Serve a domain in a thread while within; the listening socket is closed then. An error ends it, and is logged."""
    loop = asyncio.new_event_loop()
    task = loop.create_task(serve_domain(files, listening))

    def serve() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        except Exception:  # an error of this server must not end the process that keeps the machines
            log.exception("enrolment server failed")
        finally:
            loop.run_until_complete(loop.shutdown_asyncgens())
            loop.close()

    thread = threading.Thread(target=serve, name="enrolment server")
    thread.start()
    try:
        yield
    finally:
        with contextlib.suppress(RuntimeError):  # the server has ended, and its loop is closed
            loop.call_soon_threadsafe(task.cancel)
        thread.join()
