"""Sessions for programs with threads: publish, subscribe, serve and call.

I/O, by its driver. Any thread may use a session and the objects that it opens; ``aio.py`` has the same for asyncio.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from types import TracebackType

from gdp.closing import ClosedOnExit
from gdp.intervals import ATTACH_S, GOODBYE_S, LINGER_S
from gdp.service.replication import Replication
from gdp.session.driver import Driver, ThreadDriver
from gdp.session.node import SessionNode
from gdp.session.protocol.client_core import CALL_TIMEOUT_S
from gdp.session.protocol.errors import ClosedError, SessionTimeoutError
from gdp.session.protocol.messages import Message, NameLike, Paths, Request, Response, Sign
from gdp.session.protocol.opened import BasePublisher, BaseServer, BaseSession, BaseSubscription
from gdp.session.protocol.wire import message_to_wire
from gdp.session.settings import SessionConfig, settings_of
from gdp.trust.advertisement import paths_value, session_value

log = logging.getLogger(__name__)


class Publisher(BasePublisher[Driver], ClosedOnExit):
    """Publisher of one name; made by ``Session.publisher``."""

    def put(self, payload: bytes, timeout_s: float | None = None) -> None:
        """Publish a message.

        A reliable publisher waits while its window is full, so no reader loses a message to a fast publisher. A message
        without a reader is lost, unless the publisher is ``latched``; see ``wait_for_readers``.

        Args:
            payload: at most ``MESSAGE_MAX_BYTES`` less 14.
            timeout_s: longest wait while the window is full; None: no limit.

        Raises:
            SessionTimeoutError: the window stayed full.
            LocalError: the payload is too large, or not bytes.
            ClosedError: the publisher or the session is closed.
        """
        self._check(payload)
        must_wait = self._is_reliable and not self._publisher.has_space()
        if must_wait and not self._driver.wait(self._may_put, _deadline_s(self._driver, timeout_s)):
            raise self._window_full(timeout_s)
        self._driver.publish(self._publisher, message_to_wire(time.time_ns(), payload))

    def wait_for_readers(self, count: int = 1, timeout_s: float | None = None) -> None:
        """Wait until at least ``count`` readers are matched.

        Raises:
            SessionTimeoutError: the readers did not appear in time; the text gives the reason if it is known.
        """
        if not self._driver.wait(lambda: self._publisher.readers >= count, _deadline_s(self._driver, timeout_s)):
            raise self._too_few_readers(count, timeout_s)

    def flush(self, timeout_s: float | None = None) -> None:
        """Wait until every reader has confirmed every message; without ``reliable``, until every message is sent.

        Raises:
            SessionTimeoutError: that did not happen in time.
        """
        if not self._driver.wait(self._publisher.is_acknowledged, _deadline_s(self._driver, timeout_s)):
            raise self._unconfirmed(timeout_s)


class Subscription(BaseSubscription[Driver], ClosedOnExit):
    """Messages of one name as an iterator that waits for the next; made by ``Session.subscribe``."""

    def receive(self, timeout_s: float | None = None) -> Message:
        """Return the next message; messages of one publisher come in order.

        Args:
            timeout_s: longest wait; None: no limit.

        Raises:
            SessionTimeoutError: no message came in time.
            ClosedError: the subscription or the session is closed.
        """
        try:
            return self._messages.popleft()
        except IndexError:
            return self._wait(_deadline_s(self._driver, timeout_s), timeout_s)

    def _wait(self, deadline_s: float | None, timeout_s: float | None) -> Message:
        while True:
            if not self._driver.wait(self.is_ready, deadline_s):
                raise self._no_message(timeout_s)
            try:
                return self._messages.popleft()
            except IndexError:  # another thread received it, or the subscription was closed
                if self._is_closed:
                    raise self._closed() from None

    def poll(self) -> Message | None:
        """Return the next message if one has arrived, else None; never waits."""
        try:
            return self._messages.popleft()
        except IndexError:
            return None

    def __iter__(self) -> Iterator[Message]:
        return self

    def __next__(self) -> Message:
        """Return the next message; the iteration ends when the subscription or the session is closed."""
        try:
            return self.receive()
        except ClosedError:
            raise StopIteration from None


Handler = Callable[[Request], bytes]


class Server(BaseServer[Driver, Handler], ClosedOnExit):
    """Server of one name with a handler; made by ``Session.serve``."""

    def _start(self, workers: int) -> None:
        for number in range(workers):
            name = f"gdp-serve-{self.name.short}-{number}"
            threading.Thread(target=self._work, name=name, daemon=True).start()

    def close(self, linger_s: float = LINGER_S) -> None:
        """Stop serving: direct clients to other servers, finish active requests, then withdraw. Idempotent.

        Args:
            linger_s: longest time for active requests; the others fail.
        """
        if self._is_closed:
            return
        self._session.forget(self)
        self._driver.run(self._core.leave)
        if not self._driver.wait(lambda: self._core.is_idle, self._driver.now_s() + linger_s):
            log.warning("server closed with active requests, or unconfirmed responses name=%s", self._label)
        self._is_closed = True
        self._driver.run(lambda: self._session.core.close_server(self._core, self._driver.now_s()))

    def serve_forever(self) -> None:
        """Wait until the server or the session is closed, for a program that only serves."""
        self.is_closed_within(None)

    def is_closed_within(self, timeout_s: float | None) -> bool:
        """Wait so long at most until the server or the session is closed; return whether it is. None: no limit."""
        try:
            return self._driver.wait(lambda: self._is_closed, _deadline_s(self._driver, timeout_s))
        except ClosedError:
            return True

    def _work(self) -> None:
        """Handle requests one after the other, as one of the workers."""
        turns = self._core.turns
        try:
            while not self._is_closed:
                self._driver.wait(lambda: bool(turns) or self._is_closed, None)
                try:
                    turn = turns.popleft()
                except IndexError:
                    continue  # another worker handles it
                outcome = outcome_of(self._handler, Request(turn.request, turn.asked.client))
                self._driver.run(partial(self._core.finish, turn.number, outcome, self._driver.now_s()))
        except ClosedError:
            return


class Session(BaseSession[Driver, Publisher, Subscription, Server, Handler]):
    """A node of the overlay in this process; made by ``gdp.open``.

    Use it as a context manager, or call ``close``: then readers get the published messages, and the overlay learns at
    once that the node has left.
    """

    _publisher_type, _subscription_type, _server_type = Publisher, Subscription, Server

    def receive_any(
        self, subscriptions: Collection[Subscription], timeout_s: float | None = None
    ) -> tuple[Subscription, Message]:
        """Return the next message of several subscriptions, and its subscription, for a thread that reads many names.

        Raises:
            SessionTimeoutError: no message came in time.
            ClosedError: the session is closed.
        """
        deadline_s = _deadline_s(self.driver, timeout_s)
        while self.driver.wait(lambda: any(map(Subscription.is_ready, subscriptions)), deadline_s):
            for each in subscriptions:
                message = each.poll()
                if message is not None:
                    return each, message
            if not any(each in self._opened for each in subscriptions):
                raise ClosedError("every subscription is closed; subscribe again")
        raise SessionTimeoutError(f"no message on {len(subscriptions)} subscription(s) within {timeout_s:g} s")

    def call(
        self,
        name: NameLike,
        request: bytes,
        *,
        timeout_s: float | None = CALL_TIMEOUT_S,
        replication: str | int | Replication = "all",
        paths: Paths = 1,
        sign: Sign = "always",
    ) -> Response:
        """Send a request to the servers of a name and return the first response.

        Args:
            name: as for ``publisher``.
            timeout_s: longest wait for a server and its response; None: no limit.
            replication: ``"all"``: every server gets the request; ``"hedged"``: one server, and a second one if the
                first is slow; ``"nearest"``: the nearest server, and the next one if that falls silent; a number:
                that many servers, the fastest ones; or a ``Replication``.
            paths: 2: over two disjoint paths, to servers with 2 as well. The first call on a name decides.
            sign: as for ``serve``. The first call on a name decides.

        Raises:
            NoServerError: no server is available.
            CallTimeoutError: no server responded in time.
            CallError: every server refused, or its handler raised.
            DelegationError: the node may not call it.
        """
        topic, call = self._new_call(name, request, timeout_s, replication)
        is_session = session_value(sign)
        self.driver.run(
            lambda: self.core.call(topic, call, self.driver.now_s(), paths_value(paths), is_session=is_session)
        )
        self.driver.wait(lambda: call.is_done, None)
        if call.response is None:
            raise call.error or ClosedError("the session was closed during the call")
        return call.response

    def close(self, linger_s: float = LINGER_S) -> None:
        """Close all publishers, subscriptions and servers, and leave the overlay. Idempotent.

        Args:
            linger_s: longest wait for the confirmation of published messages, and for active requests.
        """
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._finish(self.driver.now_s() + linger_s)
        except ClosedError as error:
            log.warning("the session ended without a goodbye reason=%s", error)
        finally:
            self.driver.close()
            self._node.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close(0.0 if error is not None else LINGER_S)

    def wait_until_attached(self, timeout_s: float = ATTACH_S) -> None:
        """Wait until a switch has accepted the node.

        Raises:
            AttachError: no switch accepted it in time; the text states what the node waits for.
        """
        if not self.driver.wait(lambda: self.is_attached, self.driver.now_s() + timeout_s):
            raise self._not_attached(timeout_s)

    def _finish(self, deadline_s: float) -> None:
        publishers = [each for each in self._opened if isinstance(each, Publisher)]
        for each in list(self._opened):
            if isinstance(each, Server):
                each.close(max(deadline_s - self.driver.now_s(), 0.0))
        for publisher in publishers:
            if publisher.readers:
                self.driver.wait(publisher._publisher.is_acknowledged, deadline_s)
        for opened in list(self._opened):
            if isinstance(opened, ClosedOnExit):
                opened.close()
        self.driver.run(lambda: self.core.close(self.driver.now_s()))
        self.driver.wait(lambda: False, self.driver.now_s() + GOODBYE_S)


def open_session(
    node: str | os.PathLike[str],
    *,
    iface: str | None = None,
    root: str | os.PathLike[str] | None = None,
    trusts: Sequence[str | os.PathLike[str]] | None = None,
    delegations: str | os.PathLike[str] | None = None,
    state: str | os.PathLike[str] | None = None,
    lease_s: float | None = None,
    busy_poll_us: int | None = None,
    timeout_s: float = ATTACH_S,
) -> Session:
    """Open a session: attach this process to the overlay as a node.

    Args:
        node: the node's directory, as ``gdp keygen node`` and ``gdp cert issue`` made it, or a configuration file: a
            ``proxy.yaml``, of which a session uses ``identity``, ``domain``, ``iface``, ``delegations`` and ``state``.
            For a directory ``robot/proxy`` it reads ``robot/proxy.yaml`` if that exists.
        iface: device towards the switch. Default: the configuration's; else the directory's name and a 0 (``proxy0``),
            as ``attach`` of the switch makes it.
        root: certificate of the node's trust domain. Default: the configuration's; else ``root.crt`` of the directory.
        trusts: root certificates of other domains that are trusted.
        delegations: directory of the node's delegations. Default: the configuration's; else ``delegations`` in the
            node's directory.
        state: directory that keeps revocations across restarts.
        lease_s: lease of what the node advertises.
        busy_poll_us: microseconds to poll for more frames before sleeping, where most waits were shorter. 0: never.
        timeout_s: longest wait until a switch has accepted the node.

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
        busy_poll_us=busy_poll_us,
    )
    return open_node(config, timeout_s)


def open_node(config: SessionConfig, timeout_s: float = ATTACH_S) -> Session:
    """Open a session with these settings, as ``open_session`` does. Raises ``LocalError`` or ``AttachError``."""
    made = SessionNode(config)
    session = Session(made, ThreadDriver(made.core, made.runtime))
    try:
        session.wait_until_attached(timeout_s)
    except BaseException:
        session.close(0.0)
        raise
    return session


def outcome_of(handler: Callable[[Request], bytes], request: Request) -> bytes | str:
    """Return a handler's response, or as text the reason for its failure."""
    try:
        response = handler(request)
    except Exception as error:  # an error of the program's handler
        log.exception("a handler failed client=%s", request.client.short)
        return f"{type(error).__name__}: {error}"
    return checked_response(response)


def checked_response(response: object) -> bytes | str:
    """Return a response as bytes, or as text that it is not bytes."""
    if isinstance(response, bytes | bytearray | memoryview):
        return bytes(response)
    return f"the handler returned {type(response).__name__}, not bytes"


def _deadline_s(driver: Driver, timeout_s: float | None) -> float | None:
    return None if timeout_s is None else driver.now_s() + timeout_s
