"""Door endpoint: a graph of WebSocket clients, for the bridge.

I/O. A thread runs the WebSocket server (the library ``websockets``) and the hub; the bridge's thread passes commands to
it and takes events from it. Each client has a task that sends what its queue holds, so a slow client delays its own
messages only. Browsers state the origin of the page that connects: only listed origins may. Every user of the host may
connect, so a client of another user states the token of the door in its URL.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from itertools import count
from typing import TYPE_CHECKING, Final, TypeAlias
from urllib.parse import quote

from gdp.access_token import is_access_token, query_token
from gdp.errors import GdpError, LocalError
from gdp.extras import require_extra
from gdp.host_port import split_host_port
from gdp.intervals import FORGET_S
from gdp.ports.socket_owners import SocketOwners
from gdp.ports.tcp_server import listen_tcp
from gdp_extensions.doors.core.arrivals import Arrivals
from gdp_extensions.doors.core.client_queue import DATA_MAX_BYTES, DATA_MAX_MESSAGES, ClientQueue, Pending
from gdp_extensions.doors.core.hub import DoorSession, Hub
from proxy.bridge.core.delegated_rules import DelegatedRules
from proxy.endpoints.core.endpoint import Event, Graph, MessageReceived, RequestReceived
from proxy.endpoints.in_process import InProcessEndpoint
from proxy.serial.channel import Channel, Qos, Service
from proxy.serial.standard_types import known_channel

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

log = logging.getLogger(__name__)
wire_log = logging.getLogger(f"{__name__}.wire")
wire_log.setLevel(logging.INFO)  # the library's DEBUG has URLs with tokens, and what clients send

NewSession: TypeAlias = "Callable[[Hub, int, ClientQueue], DoorSession]"

INPUT_MAX_BYTES: Final = 64 << 20  # messages and requests of clients that wait for the bridge
OUTPUT_MAX_BYTES: Final = 64 << 20  # messages of the bridge that wait for the server's thread
MESSAGE_MAX_BYTES: Final = 32 << 20  # of one message of a client
ARRIVING_MAX_BYTES: Final = 64 << 20  # of the messages of all clients that have not come whole yet
WAITING_MAX_BYTES: Final = 256 << 20  # of what waits for all clients
_REPORT_S: Final = 1.0  # at most one report of dropped messages a second
_TRY_AGAIN: Final = 1013  # close code of the IANA registry


@dataclass(frozen=True, slots=True, kw_only=True)
class DoorSettings:
    """How a door listens, and its bounds.

    Args:
        listen: ``host:port``.
        origins: values of the header Origin that are accepted; a client without the header is no browser, and accepted.
        subprotocols: WebSocket subprotocols, one of which a client must speak; none: it needs no subprotocol.
        token: that a client of another user, or from elsewhere, states in its URL; empty: none states it.
    """

    label: str
    listen: str
    origins: tuple[str, ...] = ()
    subprotocols: tuple[str, ...] = ()
    token: str = field(default="", repr=False)
    clients_max: int = 64
    queue_max_bytes: int = DATA_MAX_BYTES
    queue_max_messages: int = DATA_MAX_MESSAGES


@dataclass(slots=True)
class _Client:
    session: DoorSession
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    reported: int = 0  # dropped messages that the client knows of
    reported_at_s: float = 0.0

    given_bytes: int = 0  # of what it sent to the bridge; written by the server's thread
    taken_bytes: int = 0  # the same, by the bridge's thread

    @property
    def queue(self) -> ClientQueue:
        """Return what waits for the client."""
        return self.session.queue


class DoorEndpoint(InProcessEndpoint):
    """Endpoint whose nodes are the clients of a WebSocket server.

    Raises:
        LocalError: the address cannot be listened on, or ``websockets`` is not installed.
    """

    kind = "a door"

    def __init__(self, settings: DoorSettings, new_session: NewSession, rights: Callable[[], DelegatedRules]) -> None:
        require_extra("doors", ["websockets"], settings.label)
        super().__init__()
        self._settings = settings
        self._new_session = new_session
        self._heard: deque[tuple[Event, _Client | None]] = deque()  # events, and whose they are
        self._speaker: _Client | None = None  # whose message is being processed
        self._arrivals = Arrivals["ServerConnection"](ARRIVING_MAX_BYTES)
        self._input_bytes = 0  # written by the server's thread
        self._taken_bytes = 0  # written by the bridge's thread
        self._output_bytes = 0  # written by the bridge's thread
        self._passed_bytes = 0  # written by the server's thread
        self._lost = 0  # messages that either bound has dropped
        self._unwritten = 0  # messages that drew an error of this program when they were written for a client
        self._handles = count(1)
        self._sessions = count(1)
        self._hub = Hub(self._emit, rights, _known_or_none)
        self._clients: dict[int, _Client] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._due_s = 0.0
        try:
            self._socket = listen_tcp(*split_host_port(settings.listen))
        except OSError as error:
            os.close(self._wake)
            raise LocalError(
                f"cannot listen on {settings.listen}: {error.strerror}; choose another address with --listen"
            ) from error
        self._owners = SocketOwners()
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._failed: BaseException | None = None
        started = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(started,), name=settings.label, daemon=True)
        self._thread.start()
        started.wait()
        if self._failed is not None:
            self.shut_down()
            raise LocalError(f"{settings.label} did not start: {self._failed}")

    @property
    def address(self) -> tuple[str, int]:
        """Return host and port."""
        host, port = self._socket.getsockname()[:2]
        return host, port

    @property
    def label(self) -> str:
        """Return the display name."""
        return f"{self._settings.label} {self._origin}"

    @property
    def url(self) -> str:
        """Return the address for clients, with the token; ``label`` has none."""
        return f"{self._origin}/?token={quote(self._settings.token)}" if self._settings.token else self._origin

    @property
    def _origin(self) -> str:
        host, port = self.address
        return f"ws://{f'[{host}]' if ':' in host else host}:{port}"

    @property
    def dropped(self) -> int:
        """Return the messages dropped because a queue was full, or because they could not be written."""
        return self._hub.dropped + self._lost + self._unwritten

    @property
    def clients(self) -> int:
        """Return the number of connections."""
        return len(self._clients)

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        events = list[Event]()
        while self._heard:
            event, speaker = self._heard.popleft()
            if isinstance(event, MessageReceived | RequestReceived):
                self._taken_bytes += len(event.raw)
                if speaker is not None:
                    speaker.taken_bytes += len(event.raw)
            events.append(event)
        return events

    def graph(self) -> Graph:
        """Return what the clients read and publish."""
        return self._hub.graph

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return a standard type; any other is read from a publisher. Raises ``LocalError``: it is none."""
        try:
            return known_channel(topic, type_name)
        except LocalError:
            self._do(self._hub.want_definition, topic, type_name)
            raise

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Take what clients publish under a name."""
        del qos
        handle = next(self._handles)
        self._do(self._hub.take_topic, handle, topic, type_name)
        return handle

    def advertise(self, channel: Channel) -> int:
        """Offer a topic to the clients."""
        handle = next(self._handles)
        self._do(self._hub.offer_topic, handle, channel)
        return handle

    def publish(self, handle: int, raw: bytes) -> None:
        """Pass a message on; it is dropped and counted where the server's thread does not keep up at all."""
        if self._output_bytes - self._passed_bytes > OUTPUT_MAX_BYTES:
            self._lost += 1
            return
        self._output_bytes += len(raw)
        self._do(self._publish, handle, time.time_ns(), raw)

    def serve(self, service: Service) -> int:
        """Offer a service to the clients."""
        handle = next(self._handles)
        self._do(self._hub.offer_service, handle, service)
        return handle

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a client's request."""
        del handle
        self._do(self._hub.pass_answer, ticket, raw)

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Fail a client's request."""
        del handle
        self._do(self._hub.pass_refusal, ticket, reason)

    def close(self, handle: int) -> None:
        """Close a subscription, publisher or server."""
        self._do(self._hub.close, handle, time.monotonic())

    def shut_down(self) -> None:
        """Disconnect the clients and end the thread."""
        if self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()
        self._socket.close()
        self._owners.close()
        super().shut_down()

    # the server's thread

    def _do(self, act: Callable[..., None], *arguments: object) -> None:
        self._loop.call_soon_threadsafe(self._act, act, arguments)

    def _act(self, act: Callable[..., None], arguments: tuple[object, ...]) -> None:
        act(*arguments)
        self._settle()

    def _settle(self) -> None:
        """Wake the tasks that send, and set the timer."""
        queues = [each.queue for each in self._clients.values()]
        if sum(each.waiting_bytes for each in queues) > WAITING_MAX_BYTES:
            max(queues, key=lambda each: each.waiting_bytes).is_overrun = True
        self._wake_clients()
        due_s = self._hub.get_timer()
        if due_s is None or (self._timer is not None and self._due_s <= due_s):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._due_s = due_s
        self._timer = self._loop.call_later(max(due_s - time.monotonic(), 0.0), self._handle_timer)

    def _handle_timer(self) -> None:
        self._timer = None
        self._hub.handle_timer(time.monotonic())
        self._settle()

    def _publish(self, handle: int, stamp_ns: int, raw: bytes) -> None:
        self._passed_bytes += len(raw)
        self._hub.pass_message(handle, stamp_ns, raw)

    def _wake_clients(self) -> None:
        for client in self._clients.values():
            client.wake.set()

    def _emit(self, event: Event) -> None:
        speaker = self._speaker
        if isinstance(event, MessageReceived | RequestReceived):
            if not self._has_capacity(speaker, len(event.raw)):
                self._lost += 1
                if isinstance(event, RequestReceived):
                    self._hub.pass_refusal(event.ticket, "the door has too much to do; call again later")
                return
            self._input_bytes += len(event.raw)
            if speaker is not None:
                speaker.given_bytes += len(event.raw)
        self._heard.append((event, speaker))
        os.eventfd_write(self._wake, 1)

    def _has_capacity(self, speaker: _Client | None, size_bytes: int) -> bool:
        """Return whether the bridge's input has capacity for one more message; a client never has more than is free."""
        free_bytes = INPUT_MAX_BYTES - (self._input_bytes - self._taken_bytes)
        own_bytes = 0 if speaker is None else speaker.given_bytes - speaker.taken_bytes
        return size_bytes + own_bytes <= free_bytes

    def _run(self, started: threading.Event) -> None:
        try:
            self._loop.run_until_complete(self._serve(started))
        except Exception as error:
            log.exception("the server of a door failed")
            self._failed = error
        finally:
            self._loop.close()
            started.set()

    async def _serve(self, started: threading.Event) -> None:
        from websockets.asyncio.server import ServerConnection, serve
        from websockets.typing import Origin, Subprotocol

        arrivals = self._arrivals

        class Connection(ServerConnection):
            """Connection whose bytes are counted before the library keeps them."""

            def data_received(self, data: bytes) -> None:
                """Process bytes of the client."""
                for each in arrivals.count(self, len(data)):
                    log.info("client disconnected: its message does not end, and those of all exceed their bound")
                    each.transport.abort()
                super().data_received(data)

            def connection_lost(self, exc: Exception | None) -> None:
                """Process the end of the connection."""
                arrivals.end(self)
                super().connection_lost(exc)

        server = await serve(
            self._attend,
            create_connection=Connection,
            sock=self._socket,
            process_request=self._admit,
            origins=[None, *map(Origin, self._settings.origins)],
            subprotocols=[Subprotocol(each) for each in self._settings.subprotocols] or None,
            compression=None,
            max_size=MESSAGE_MAX_BYTES,
            ping_timeout=FORGET_S,
            logger=wire_log,
        )
        started.set()
        try:
            await self._stop.wait()
        finally:
            server.close()
            await server.wait_closed()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a refusal; None: the client knows the token, or is a program of this user on this machine."""
        token = self._settings.token
        if not token or is_access_token(query_token(request.path), token):
            return None
        client, server = connection.remote_address[:2], connection.local_address[:2]
        if self._owners.is_mine(client, server):
            return None
        log.info("client without the token refused")
        return connection.respond(HTTPStatus.UNAUTHORIZED, "connect to the URL that the command of this door printed\n")

    async def _attend(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        if len(self._clients) >= self._settings.clients_max:
            await connection.close(_TRY_AGAIN, f"this door has {len(self._clients)} clients already")
            return
        queue = ClientQueue(self._settings.queue_max_bytes, self._settings.queue_max_messages)
        client = _Client(self._new_session(self._hub, next(self._sessions), queue))
        self._clients[client.session.number] = client
        self._hub.open(client.session)
        sender = asyncio.create_task(self._send(connection, client))
        try:
            async for data in connection:
                self._arrivals.end(connection)
                self._speaker = client
                try:
                    client.session.handle_message(data, time.time_ns())
                except GdpError as error:
                    client.session.tell_wrong(str(error))
                finally:
                    self._speaker = None
                self._settle()
        except ConnectionClosed as error:
            log.debug("client gone session=%d reason=%s", client.session.number, error)
        finally:
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
            del self._clients[client.session.number]
            self._hub.end(client.session)
            self._settle()

    async def _send(self, connection: ServerConnection, client: _Client) -> None:
        """Send what waits for a client, as fast as its connection takes it."""
        from websockets.exceptions import ConnectionClosed

        queue, session = client.queue, client.session
        try:
            while True:
                now_s = time.monotonic()
                if queue.dropped > client.reported and now_s >= client.reported_at_s + _REPORT_S:
                    client.reported, client.reported_at_s = queue.dropped, now_s
                    session.tell_dropped(queue.dropped)
                if queue.is_overrun:
                    await connection.close(_TRY_AGAIN, "this client does not read")
                    return
                item = queue.pop()
                if item is None:
                    client.wake.clear()
                    await client.wake.wait()
                elif (wire := self._encoded(session, item) if isinstance(item, Pending) else item) is not None:
                    await connection.send(wire)
        except ConnectionClosed:
            log.debug("client gone while sending session=%d", session.number)

    def _encoded(self, session: DoorSession, item: Pending) -> str | bytes | None:
        """Return what a client gets; None: its message drew an error of this program, of which the client hears."""
        try:
            return session.encode(item)
        except Exception as error:  # one message must not make its client deaf
            self._unwritten += 1
            if self._unwritten == 1:
                log.exception("a message could not be written for a client; the door goes on")
            session.tell_wrong(f"a message was left out: it drew an error of this door ({type(error).__name__})")
            return None


def _known_or_none(topic: str, type_name: str) -> Channel | None:
    try:
        return known_channel(topic, type_name)
    except LocalError:
        return None
