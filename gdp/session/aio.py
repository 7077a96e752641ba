"""Sessions for asyncio: the interface of ``session.py`` over the same core, in the program's own event loop.

I/O, by its driver. Only the loop in which a session was opened may use it.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Generator, Sequence
from types import TracebackType
from typing import TypeVar

from gdp.intervals import ATTACH_S, GOODBYE_S, LINGER_S
from gdp.service.replication import Replication
from gdp.session.loop_driver import LoopDriver
from gdp.session.node import SessionNode
from gdp.session.protocol.client_core import CALL_TIMEOUT_S
from gdp.session.protocol.errors import ClosedError
from gdp.session.protocol.messages import Message, NameLike, Paths, Request, Response, Sign
from gdp.session.protocol.opened import BasePublisher, BaseServer, BaseSession, BaseSubscription
from gdp.session.protocol.wire import message_to_wire
from gdp.session.session import checked_response
from gdp.session.settings import SessionConfig, settings_of
from gdp.trust.advertisement import paths_value, session_value

log = logging.getLogger(__name__)

_C = TypeVar("_C")


class _ClosedOnExit(ABC):
    """Asynchronous context manager that closes itself."""

    @abstractmethod
    def close(self) -> None:
        """Close the object. Idempotent."""

    async def __aenter__(self: _C) -> _C:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()


class AsyncPublisher(BasePublisher[LoopDriver], _ClosedOnExit):
    """Publisher of one name; made by ``AsyncSession.publisher``. See ``Publisher`` for each method."""

    async def put(self, payload: bytes, timeout_s: float | None = None) -> None:
        """Publish a message; a reliable publisher waits while its window is full.

        Raises:
            SessionTimeoutError: the window stayed full.
            LocalError: the payload is too large.
            ClosedError: the publisher or the session is closed.
        """
        self._check(payload)
        must_wait = self._is_reliable and not self._publisher.has_space()
        if must_wait and not await self._driver.wait(self._may_put, _deadline_s(timeout_s)):
            raise self._window_full(timeout_s)
        self._driver.publish(self._publisher, message_to_wire(time.time_ns(), payload))

    async def wait_for_readers(self, count: int = 1, timeout_s: float | None = None) -> None:
        """Wait until at least ``count`` readers are matched.

        Raises:
            SessionTimeoutError: the readers did not appear in time.
        """
        if not await self._driver.wait(lambda: self._publisher.readers >= count, _deadline_s(timeout_s)):
            raise self._too_few_readers(count, timeout_s)

    async def flush(self, timeout_s: float | None = None) -> None:
        """Wait until every reader has confirmed every message.

        Raises:
            SessionTimeoutError: some reader did not confirm in time.
        """
        if not await self._driver.wait(self._publisher.is_acknowledged, _deadline_s(timeout_s)):
            raise self._unconfirmed(timeout_s)


class AsyncSubscription(BaseSubscription[LoopDriver], _ClosedOnExit):
    """Messages of one name as an asynchronous iterator; made by ``AsyncSession.subscribe``."""

    async def receive(self, timeout_s: float | None = None) -> Message:
        """Return the next message; messages of one publisher come in order.

        Raises:
            SessionTimeoutError: no message came in time.
            ClosedError: the subscription or the session is closed.
        """
        deadline_s = _deadline_s(timeout_s)
        while not self._messages:
            if self._is_closed:
                raise self._closed()
            if not await self._driver.wait(self.is_ready, deadline_s):
                raise self._no_message(timeout_s)
        return self._messages.popleft()

    def __aiter__(self) -> AsyncSubscription:
        return self

    async def __anext__(self) -> Message:
        """Return the next message; the iteration ends when the subscription or the session is closed."""
        try:
            return await self.receive()
        except ClosedError:
            raise StopAsyncIteration from None


Handler = Callable[[Request], Awaitable[bytes]]


class AsyncServer(BaseServer[LoopDriver, Handler]):
    """Server of one name with a coroutine function; made by ``AsyncSession.serve``."""

    def _start(self, workers: int) -> None:
        self._tasks = [asyncio.create_task(self._work()) for _ in range(workers)]

    async def close(self, linger_s: float = LINGER_S) -> None:
        """Stop serving: clients use other servers, and active requests finish. Idempotent."""
        if self._is_closed:
            return
        self._session.forget(self)
        self._core.leave()
        self._driver.schedule()
        if not await self._driver.wait(lambda: self._core.is_idle, time.monotonic() + linger_s):
            log.warning("server closed with active requests, or unconfirmed responses name=%s", self._label)
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
                outcome = await self._outcome(Request(turn.request, turn.asked.client))
                self._core.finish(turn.number, outcome, time.monotonic())
                self._driver.schedule()
        except ClosedError:
            return

    async def _outcome(self, request: Request) -> bytes | str:
        try:
            return checked_response(await self._handler(request))
        except Exception as error:  # an error of the program's handler
            log.exception("a handler failed client=%s", request.client.short)
            return f"{type(error).__name__}: {error}"


class AsyncSession(BaseSession[LoopDriver, AsyncPublisher, AsyncSubscription, AsyncServer, Handler]):
    """A node of the overlay in this process; made by ``gdp.open_async``."""

    _publisher_type, _subscription_type, _server_type = AsyncPublisher, AsyncSubscription, AsyncServer

    async def call(
        self,
        name: NameLike,
        request: bytes,
        *,
        timeout_s: float | None = CALL_TIMEOUT_S,
        replication: str | int | Replication = "all",
        paths: Paths = 1,
        sign: Sign = "always",
    ) -> Response:
        """Send a request to the servers of a name and return the first response; see ``Session.call``.

        Raises:
            NoServerError: no server is there.
            CallTimeoutError: none responded in time.
            CallError: every server refused, or its handler raised.
            DelegationError: the node may not call it.
        """
        self.driver.check()
        topic, call = self._new_call(name, request, timeout_s, replication)
        self.core.call(topic, call, time.monotonic(), paths_value(paths), is_session=session_value(sign))
        self.driver.schedule()
        await self.driver.wait(lambda: call.is_done, None)
        if call.response is None:
            raise call.error or ClosedError("the session was closed during the call")
        return call.response

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

    async def wait_until_attached(self, timeout_s: float = ATTACH_S) -> None:
        """Wait until a switch has accepted the node.

        Raises:
            AttachError: no switch accepted it in time; the text states what the node waits for.
        """
        if not await self.driver.wait(lambda: self.is_attached, time.monotonic() + timeout_s):
            raise self._not_attached(timeout_s)

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
            if isinstance(opened, _ClosedOnExit):
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
        node = SessionNode(self._config)
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
    timeout_s: float = ATTACH_S,
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
