"""Sessions for asyncio: the interface of ``session.py`` over the same core, in the program's own event loop.

I/O, by its driver. Only the loop in which a session was opened may use it.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Awaitable, Callable, Generator, Sequence
from types import TracebackType

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher as MemberPublisher
from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.replication import Replication
from gdp.session.client_core import Call
from gdp.session.core import QUEUE_MESSAGES, Inbox, replication_of
from gdp.session.errors import AttachError, ClosedError, SessionTimeoutError
from gdp.session.loop_driver import LoopDriver
from gdp.session.messages import DelegatedName, Message, NameLike, Request, Response
from gdp.session.node import SessionNode, open_node
from gdp.session.server_core import ServerCore
from gdp.session.session import (
    ATTACH_TIMEOUT_S,
    CALL_TIMEOUT_S,
    GOODBYE_S,
    LINGER_S,
    Priority,
    checked_response,
    is_urgent,
)
from gdp.session.settings import SessionConfig, settings_of
from gdp.session.wire import PAYLOAD_MAX_BYTES, message_to_wire
from gdp.trust.right import Right

__all__ = ["AsyncPublisher", "AsyncServer", "AsyncSession", "AsyncSubscription", "open_session_async"]

log = logging.getLogger(__name__)


class AsyncPublisher:
    """Publisher of one name; made by ``AsyncSession.publisher``. See ``Publisher`` for each method."""

    def __init__(self, session: AsyncSession, topic: Topic, publisher: MemberPublisher, *, reliable: bool) -> None:
        self._session = session
        self._driver = session.driver
        self._topic = topic
        self._publisher = publisher
        self._is_reliable = reliable
        self._is_closed = False

    @property
    def name(self) -> Name:
        """Return the 256-bit name."""
        return self._topic.name

    @property
    def readers(self) -> int:
        """Return the number of matched readers."""
        return self._publisher.readers

    @property
    def confirmed(self) -> int:
        """Return how many messages every reader has confirmed; without ``reliable``, how many were sent."""
        return self._publisher.acknowledged

    @property
    def lost(self) -> int:
        """Return how many messages some reader did not get, as far as this node knows."""
        return self._publisher.losses.total

    @property
    def resent(self) -> int:
        """Return how many fragments were retransmitted because a reader lacked them."""
        return self._publisher.repairs

    async def put(self, payload: bytes, timeout_s: float | None = None) -> None:
        """Publish a message; a reliable publisher waits while its window is full.

        Raises:
            SessionTimeoutError: the window stayed full.
            LocalError: the payload is too large.
            ClosedError: the publisher or the session is closed.
        """
        label = self._session.core.label(self._topic)
        if self._is_closed:
            raise ClosedError(f"the publisher of {label} is closed; open a new one with session.publisher()")
        if len(payload) > PAYLOAD_MAX_BYTES:
            raise LocalError(f"{label}: {len(payload)} bytes; at most {PAYLOAD_MAX_BYTES} fit into one message")
        publisher = self._publisher
        if self._is_reliable and not publisher.has_space():
            deadline_s = _deadline_s(timeout_s)
            if not await self._driver.wait(lambda: publisher.has_space() or not publisher.is_wanted, deadline_s):
                raise SessionTimeoutError(
                    f"{label}: the window was full for {timeout_s:g} s, since a reader confirms too slowly;"
                    " publish less, or with reliable=False"
                )
        self._driver.publish(publisher, message_to_wire(time.time_ns(), payload))

    async def wait_for_readers(self, count: int = 1, timeout_s: float | None = None) -> None:
        """Wait until at least ``count`` readers are matched.

        Raises:
            SessionTimeoutError: the readers did not appear in time.
        """
        if not await self._driver.wait(lambda: self._publisher.readers >= count, _deadline_s(timeout_s)):
            label = self._session.core.label(self._topic)
            hint = self._session.why_not(self.name, "start a program that subscribes to it")
            raise SessionTimeoutError(f"{label}: {self.readers} of {count} reader(s) within {timeout_s:g} s{hint}")

    async def flush(self, timeout_s: float | None = None) -> None:
        """Wait until every reader has confirmed every message.

        Raises:
            SessionTimeoutError: some reader did not confirm in time.
        """
        if not await self._driver.wait(self._publisher.is_acknowledged, _deadline_s(timeout_s)):
            label = self._session.core.label(self._topic)
            raise SessionTimeoutError(f"{label}: not every reader has confirmed within {timeout_s:g} s")

    def close(self) -> None:
        """Stop publishing; unconfirmed messages are lost, so ``flush`` first. Idempotent."""
        if not self._is_closed:
            self._is_closed = True
            self._session.forget(self)
            self._session.core.member.withdraw(self.name)
            self._driver.schedule()

    async def __aenter__(self) -> AsyncPublisher:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()


class AsyncSubscription:
    """Messages of one name as an asynchronous iterator; made by ``AsyncSession.subscribe``."""

    def __init__(self, session: AsyncSession, topic: Topic, inbox: Inbox) -> None:
        self._session = session
        self._driver = session.driver
        self._topic = topic
        self._inbox = inbox
        self._messages = inbox.messages
        self._is_closed = False

    @property
    def name(self) -> Name:
        """Return the 256-bit name."""
        return self._topic.name

    @property
    def publishers(self) -> int:
        """Return the number of matched publishers."""
        return len(self._session.core.member.writer_proxies_of(self.name))

    @property
    def lost(self) -> int:
        """Return how many messages were lost on their way to this node."""
        return self._session.core.member.losses_of(self.name).total

    @property
    def dropped(self) -> int:
        """Return how many messages this node dropped because the program received too few."""
        return self._inbox.dropped

    async def receive(self, timeout_s: float | None = None) -> Message:
        """Return the next message; messages of one publisher come in order.

        Raises:
            SessionTimeoutError: no message came in time.
            ClosedError: the subscription or the session is closed.
        """
        deadline_s = _deadline_s(timeout_s)
        while not self._messages:
            label = self._session.core.label(self._topic)
            if self._is_closed:
                raise ClosedError(f"the subscription to {label} is closed; subscribe again")
            if not await self._driver.wait(lambda: bool(self._messages) or self._is_closed, deadline_s):
                hint = self._session.why_not(self.name, f"{self.publishers} publisher(s) are there")
                raise SessionTimeoutError(f"{label}: no message within {timeout_s:g} s{hint}")
        return self._messages.popleft()

    def __aiter__(self) -> AsyncSubscription:
        return self

    async def __anext__(self) -> Message:
        """Return the next message; the iteration ends when the subscription or the session is closed."""
        try:
            return await self.receive()
        except ClosedError:
            raise StopAsyncIteration from None

    def close(self) -> None:
        """Unsubscribe. Idempotent."""
        if not self._is_closed:
            self._is_closed = True
            self._session.forget(self)
            self._session.core.unsubscribe(self._inbox)
            self._driver.schedule()

    async def __aenter__(self) -> AsyncSubscription:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()


Handler = Callable[[Request], Awaitable[bytes]]


class AsyncServer:
    """Server of one name with a coroutine function; made by ``AsyncSession.serve``."""

    def __init__(self, session: AsyncSession, topic: Topic, server: ServerCore, handler: Handler, workers: int) -> None:
        self._session = session
        self._driver = session.driver
        self._topic = topic
        self._core = server
        self._handler = handler
        self._is_closed = False
        self._tasks = [asyncio.create_task(self._work()) for _ in range(workers)]

    @property
    def name(self) -> Name:
        """Return the 256-bit name."""
        return self._topic.name

    @property
    def clients(self) -> int:
        """Return the number of clients."""
        return self._core.clients

    async def close(self, linger_s: float = LINGER_S) -> None:
        """Stop serving: clients use other servers, and active requests finish. Idempotent."""
        if self._is_closed:
            return
        self._session.forget(self)
        self._core.leave()
        self._driver.schedule()
        await self._driver.wait(lambda: self._core.is_idle, time.monotonic() + linger_s)
        self._is_closed = True
        for task in self._tasks:
            task.cancel()
        self._session.core.close_server(self._core, time.monotonic())
        self._driver.schedule()

    async def serve_forever(self) -> None:
        """Wait until the server or the session is closed."""
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def __aenter__(self) -> AsyncServer:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.close()

    async def _work(self) -> None:
        turns = self._core.turns
        try:
            while True:
                await self._driver.wait(lambda: bool(turns), None)
                if not turns:
                    continue  # another worker handles it
                turn = turns.popleft()
                self._core.finish(turn.number, await self._outcome(Request(turn.request, turn.asked.client)))
                self._driver.schedule()
        except ClosedError:
            return

    async def _outcome(self, request: Request) -> bytes | str:
        try:
            return checked_response(await self._handler(request))
        except Exception as error:  # an error of the program's handler
            log.exception("a handler failed client=%s", request.client.short)
            return f"{type(error).__name__}: {error}"


class AsyncSession:
    """A node of the overlay in this process; made by ``gdp.open_async``. See ``Session`` for the options."""

    def __init__(self, node: SessionNode, driver: LoopDriver) -> None:
        self.core = node.core
        self.driver = driver
        self._node = node
        self._opened: list[AsyncPublisher | AsyncSubscription | AsyncServer] = []
        self._is_closed = False

    @property
    def name(self) -> Name:
        """Return the node's own name."""
        return self.core.member.name

    @property
    def delegations(self) -> list[DelegatedName]:
        """Return the names that this node holds delegations for, with its rights."""
        return self.core.delegations

    @property
    def is_attached(self) -> bool:
        """Return whether a switch has accepted the node and its advertisements."""
        return self.core.member.attachment.is_attached

    def publisher(
        self,
        name: NameLike,
        *,
        reliable: bool = True,
        priority: Priority = "normal",
        latched: int = 0,
        is_global: bool = True,
        description: bytes = b"",
    ) -> AsyncPublisher:
        """Publish a name from now on; see ``Session.publisher``.

        Raises:
            DelegationError: the node may not publish it.
            LocalError: the session publishes it already, or an option is out of bounds.
        """
        self.driver.check()
        topic = self.core.resolve(name, Right.PUBLISH)
        made = self.core.advertise(
            topic,
            reliable=reliable,
            urgent=is_urgent(priority),
            latched=latched,
            is_global=is_global,
            description=description,
        )
        publisher = AsyncPublisher(self, topic, made, reliable=reliable)
        self._opened.append(publisher)
        self.driver.schedule()
        return publisher

    def subscribe(self, name: NameLike, *, queue: int = QUEUE_MESSAGES) -> AsyncSubscription:
        """Subscribe to a name; see ``Session.subscribe``.

        Raises:
            DelegationError: the node may not read it.
            LocalError: the session subscribes to it already.
        """
        self.driver.check()
        if queue < 1:
            raise LocalError(f"queue is at least 1, not {queue}")
        topic = self.core.resolve(name, Right.READ)
        subscription = AsyncSubscription(self, topic, self.core.subscribe(topic, queue))
        self._opened.append(subscription)
        self.driver.schedule()
        return subscription

    def serve(
        self,
        name: NameLike,
        handler: Handler,
        *,
        workers: int = 1,
        priority: Priority = "normal",
        is_global: bool = True,
    ) -> AsyncServer:
        """Serve a name; ``workers`` is how many requests are handled at one time. See ``Session.serve``.

        Raises:
            DelegationError: the node may not serve it.
            LocalError: the session serves, calls or reads it already.
        """
        self.driver.check()
        if workers < 1:
            raise LocalError(f"workers is at least 1, not {workers}")
        topic = self.core.resolve(name, Right.SERVE)
        core = self.core.serve(topic, at_once=workers, is_global=is_global, urgent=is_urgent(priority))
        server = AsyncServer(self, topic, core, handler, workers)
        self._opened.append(server)
        self.driver.schedule()
        return server

    async def call(
        self,
        name: NameLike,
        request: bytes,
        *,
        timeout_s: float | None = CALL_TIMEOUT_S,
        replication: str | int | Replication = "all",
    ) -> Response:
        """Send a request to the servers of a name and return the first response; see ``Session.call``.

        Raises:
            NoServerError: no server is there.
            CallTimeoutError: none responded in time.
            CallError: every server refused, or its handler raised.
            DelegationError: the node may not call it.
        """
        self.driver.check()
        call = Call(payload=bytes(request), timeout_s=timeout_s, replication=replication_of(replication))
        if len(call.payload) > PAYLOAD_MAX_BYTES:
            raise LocalError(f"the request has {len(call.payload)} bytes; at most {PAYLOAD_MAX_BYTES} can be sent")
        self.core.call(self.core.resolve(name, Right.CALL), call, time.monotonic())
        self.driver.schedule()
        await self.driver.wait(lambda: call.is_done, None)
        if call.response is None:
            raise call.error or ClosedError("the session was closed during the call")
        return call.response

    def reload(self) -> None:
        """Read the delegations again; see ``Session.reload``.

        Raises:
            LocalError: a file is malformed, or readable for others.
        """
        self._node.reload()
        self.driver.schedule()

    async def close(self, linger_s: float = LINGER_S) -> None:
        """Close all publishers, subscriptions and servers, and leave the overlay. Idempotent."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            await self._finish(time.monotonic() + linger_s)
        except ClosedError as error:
            log.warning("the session ended without a goodbye reason=%s", error)
        finally:
            self.driver.close()
            self._node.close()

    async def wait_until_attached(self, timeout_s: float = ATTACH_TIMEOUT_S) -> None:
        """Wait until a switch has accepted the node.

        Raises:
            AttachError: no switch accepted it in time; the text states what the node waits for.
        """
        if not await self.driver.wait(lambda: self.is_attached, time.monotonic() + timeout_s):
            raise AttachError(f"not attached within {timeout_s:g} s: {self._node.waiting_for()}")

    def why_not(self, name: Name, otherwise: str) -> str:
        """Return the end of an error's sentence: why no data flows on a name, as far as this node knows."""
        if not self.is_attached:
            return f"; the node is not attached: {self._node.waiting_for()}"
        refused = self._node.refused(name)
        return f"; the advertisement was refused: {refused}" if refused else f"; {otherwise}"

    def forget(self, opened: AsyncPublisher | AsyncSubscription | AsyncServer) -> None:
        """Remove an object from the session's list after it closed itself."""
        if opened in self._opened:
            self._opened.remove(opened)

    async def __aenter__(self) -> AsyncSession:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.close(0.0 if error is not None else LINGER_S)

    async def _finish(self, deadline_s: float) -> None:
        for opened in list(self._opened):
            if isinstance(opened, AsyncServer):
                await opened.close(max(deadline_s - time.monotonic(), 0.0))
            elif isinstance(opened, AsyncPublisher) and opened.readers:
                await self.driver.wait(opened._publisher.is_acknowledged, deadline_s)
        for opened in list(self._opened):
            if not isinstance(opened, AsyncServer):
                opened.close()
        self.core.close(time.monotonic())
        self.driver.schedule()
        await self.driver.wait(lambda: False, time.monotonic() + GOODBYE_S)


class _Opening:
    """A session that is being opened: await it, or enter it with ``async with``."""

    def __init__(self, config: SessionConfig, timeout_s: float) -> None:
        self._config = config
        self._timeout_s = timeout_s
        self._session: AsyncSession | None = None

    def __await__(self) -> Generator[object, None, AsyncSession]:
        return self._open().__await__()

    async def __aenter__(self) -> AsyncSession:
        self._session = await self._open()
        return self._session

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        if self._session is not None:
            await self._session.__aexit__(kind, error, at)

    async def _open(self) -> AsyncSession:
        node = open_node(self._config)
        session = AsyncSession(node, LoopDriver(node.core, node.runtime, node.plane))
        try:
            await session.wait_until_attached(self._timeout_s)
        except BaseException:
            await session.close(0.0)
            raise
        return session


def open_session_async(
    node: str | os.PathLike[str],
    *,
    iface: str | None = None,
    root: str | os.PathLike[str] | None = None,
    trusts: Sequence[str | os.PathLike[str]] | None = None,
    delegations: str | os.PathLike[str] | None = None,
    state: str | os.PathLike[str] | None = None,
    lease_s: float | None = None,
    timeout_s: float = ATTACH_TIMEOUT_S,
) -> _Opening:
    """Open a session in the running event loop; ``await`` it, or enter it with ``async with``.

    The options are those of ``gdp.open``.

    Raises:
        LocalError: keys, delegations or the device differ from the options, or this node already runs.
        ConfigError: the configuration file is wrong.
        AttachError: no switch accepted the node in time.
    """
    config = settings_of(
        node,
        iface=iface,
        root=root,
        trusts=trusts,
        delegations=delegations,
        state=state,
        lease_s=lease_s,
        busy_poll_us=0,  # the event loop sleeps by itself
    )
    return _Opening(config, timeout_s)


def _deadline_s(timeout_s: float | None) -> float | None:
    return None if timeout_s is None else time.monotonic() + timeout_s
