"""Sessions for programs with threads: publish, subscribe, serve and call.

I/O, by its driver. Any thread may use a session and the objects that it opens; ``aio.py`` has the same for asyncio.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from types import TracebackType
from typing import Final, Literal, TypeVar

from gdp.client.participant import Topic
from gdp.client.send_options import Priority, SendOptions, is_urgent
from gdp.errors import LocalError
from gdp.service.replication import Replication
from gdp.session.driver import Driver, ThreadDriver
from gdp.session.node import SessionNode, open_node
from gdp.session.protocol.core import QUEUE_MESSAGES
from gdp.session.protocol.errors import ClosedError, SessionTimeoutError
from gdp.session.protocol.messages import Message, NameLike, Request, Response
from gdp.session.protocol.opened import BasePublisher, BaseServer, BaseSession, BaseSubscription
from gdp.session.protocol.server_core import ServerCore
from gdp.session.protocol.wire import message_to_wire
from gdp.session.settings import settings_of
from gdp.trust.advertisement import paths_value, session_value
from gdp.trust.right import Right

__all__ = ["Publisher", "Server", "Session", "Subscription", "open_session"]

log = logging.getLogger(__name__)

ATTACH_TIMEOUT_S: Final = 10.0
CALL_TIMEOUT_S: Final = 10.0
LINGER_S: Final = 1.0
GOODBYE_S: Final = 0.2  # how long a leaving node continues, so that its goodbye is sent
Paths = Literal[1, 2, "spread"]
Sign = Literal["always", "session"]

_C = TypeVar("_C")


class _ClosedOnExit(ABC):
    """Context manager that closes itself."""

    @abstractmethod
    def close(self) -> None:
        """Close the object. Idempotent."""

    def __enter__(self: _C) -> _C:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class Publisher(BasePublisher[Driver], _ClosedOnExit):
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

    def close(self) -> None:
        """Stop publishing; unconfirmed messages are lost, so ``flush`` first. Idempotent."""
        if not self._is_closed:
            self._is_closed = True
            self._session.forget(self)
            self._driver.run(partial(self._session.core.member.withdraw, self.name))


class Subscription(BaseSubscription[Driver], _ClosedOnExit):
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

    def close(self) -> None:
        """Unsubscribe. Idempotent."""
        if not self._is_closed:
            self._is_closed = True
            self._session.forget(self)
            self._driver.run(partial(self._session.core.unsubscribe, self._inbox))


class Server(BaseServer[Driver], _ClosedOnExit):
    """Server of one name with a handler; made by ``Session.serve``."""

    def __init__(
        self, session: Session, topic: Topic, server: ServerCore, handler: Callable[[Request], bytes], workers: int
    ) -> None:
        super().__init__(session, topic, server)
        self._handler = handler
        self._threads = [
            threading.Thread(target=self._work, name=f"gdp-serve-{topic.name.short}-{number}", daemon=True)
            for number in range(workers)
        ]
        for thread in self._threads:
            thread.start()

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
        try:
            self._driver.wait(lambda: self._is_closed, None)
        except ClosedError:
            return

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


class Session(BaseSession[Driver]):
    """A node of the overlay in this process; made by ``gdp.open``.

    Use it as a context manager, or call ``close``: then readers get the published messages, and the overlay learns at
    once that the node has left.
    """

    def publisher(
        self,
        name: NameLike,
        *,
        reliable: bool = True,
        priority: Priority = "normal",
        latched: int = 0,
        is_global: bool = True,
        description: bytes = b"",
        paths: Paths = 1,
        deadline_s: float | None = None,
        weight: int = 1,
        max_bits_s: float | None = None,
        repairs: bool = True,
    ) -> Publisher:
        """Publish a name from now on.

        Args:
            name: ``name`` of its metadata, such as ``"camera"``; 64 hex digits; a ``Name``; or the ``Metadata``.
            reliable: whether readers get every message, in order; otherwise lost messages stay lost.
            priority: one of seven, ``"urgent"`` to ``"background"``; ``"urgent"`` precedes others in every queue.
            latched: how many of the last messages late readers get.
            is_global: whether other domains can find the name.
            description: information that readers need to decode the messages; it travels sealed.
            paths: 2: each frame travels over two disjoint paths. ``spread``: large messages are striped over them. The
                readers subscribe with either as well.
            deadline_s: without ``reliable``: a message that cannot leave whole within this time is dropped, above 0 and
                at most 3600. None: a message that has waited for 50 ms gives way to a newer one.
            weight: share of a full path, next to other names of the same priority, 1 to 100.
            max_bits_s: most bits of frames a second, 1e3 to 1e12. None: what the path carries.
            repairs: without ``reliable``: lost parts of a message are sent again while that can be in time.

        Raises:
            DelegationError: the node may not publish it.
            LocalError: the session publishes it already, or an option is out of bounds.
        """
        topic = self.core.resolve(name, Right.PUBLISH)
        urgent = is_urgent(priority)
        made = self.driver.run(
            lambda: self.core.advertise(
                topic,
                reliable=reliable,
                urgent=urgent,
                latched=latched,
                is_global=is_global,
                description=description,
                paths=paths_value(paths),
                options=SendOptions(
                    deadline_s=deadline_s, weight=weight, max_bits_s=max_bits_s, repairs=repairs, priority=priority
                ),
            )
        )
        publisher = Publisher(self, topic, made, reliable=reliable)
        self._opened.append(publisher)
        return publisher

    def subscribe(self, name: NameLike, *, queue: int = QUEUE_MESSAGES, paths: Paths = 1) -> Subscription:
        """Subscribe to a name; iterate over the returned object.

        Args:
            name: as for ``publisher``.
            queue: most messages that wait for the program; beyond it, and beyond 64 MiB, the oldest one is dropped.
            paths: 2 or ``spread``: frames come over two disjoint paths, as the publisher says if it uses two as well.

        Raises:
            DelegationError: the node may not read it.
            LocalError: the session subscribes to it already.
        """
        if queue < 1:
            raise LocalError(f"queue is at least 1, not {queue}")
        topic = self.core.resolve(name, Right.READ)
        subscription = Subscription(
            self, topic, self.driver.run(lambda: self.core.subscribe(topic, queue, paths_value(paths)))
        )
        self._opened.append(subscription)
        return subscription

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

    def serve(
        self,
        name: NameLike,
        handler: Callable[[Request], bytes],
        *,
        workers: int = 1,
        priority: Priority = "normal",
        is_global: bool = True,
        paths: Paths = 1,
        sign: Sign = "always",
    ) -> Server:
        """Serve a name: ``handler`` gets each request and returns the response.

        Args:
            name: as for ``publisher``.
            handler: called in a worker thread. If it raises, the client gets the error's text, and may call another
            server.
            workers: number of threads, and so of requests that are handled at the same time.
            paths: 2: requests and responses travel over two disjoint paths, of clients with 2 as well.
            sign: ``session``: responses, and requests to one server, have no signature where the client says the same.
            They prove their writer to the other end, and to no third party.

        Raises:
            DelegationError: the node may not serve it.
            LocalError: the session serves, calls or reads it already.
        """
        if workers < 1:
            raise LocalError(f"workers is at least 1, not {workers}")
        topic = self.core.resolve(name, Right.SERVE)
        urgent, options = is_urgent(priority), SendOptions(priority=priority)
        core = self.driver.run(
            lambda: self.core.serve(
                topic,
                at_once=workers,
                is_global=is_global,
                urgent=urgent,
                options=options,
                paths=paths_value(paths),
                is_session=session_value(sign),
            )
        )
        server = Server(self, topic, core, handler, workers)
        self._opened.append(server)
        return server

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
                first is slow; a number: that many servers, the fastest ones; or a ``Replication``.
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

    def reload(self) -> None:
        """Read the delegations again: renewed ones and new names take effect without a message lost.

        Raises:
            LocalError: a file is malformed, or readable for others.
        """
        self.driver.run(self._node.reload)

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

    def wait_until_attached(self, timeout_s: float = ATTACH_TIMEOUT_S) -> None:
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
            if isinstance(opened, _ClosedOnExit):
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
    timeout_s: float = ATTACH_TIMEOUT_S,
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
    made: SessionNode = open_node(config)
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
