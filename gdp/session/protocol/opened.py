"""State that sessions for threads and for asyncio have in common: what they opened, its counters, its errors.

Sans-I/O, by its driver; ``session.py`` and ``aio.py`` add the calls that wait.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher
from gdp.client.send_options import Priority, SendOptions, checked, is_urgent
from gdp.errors import DropReason, GdpError, LocalError
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.service.replication import Replication
from gdp.session.protocol.client_core import Call
from gdp.session.protocol.core import QUEUE_MESSAGES, Inbox, SessionCore, replication_of
from gdp.session.protocol.errors import AttachError, ClosedError, SessionTimeoutError
from gdp.session.protocol.messages import DelegatedName, NameLike, Paths, Sign
from gdp.session.protocol.server_core import ServerCore
from gdp.session.protocol.wire import PAYLOAD_MAX_BYTES
from gdp.trust.advertisement import paths_value, session_value
from gdp.trust.right import Right

T = TypeVar("T")


class Runner(Protocol):
    """Interface of a driver to what a session opened."""

    def run(self, command: Callable[[], T]) -> T:
        """Run a command on the node and return what it returns; it must not block."""


_D = TypeVar("_D", bound=Runner)
_P = TypeVar("_P", bound="BasePublisher[Any]")
_S = TypeVar("_S", bound="BaseSubscription[Any]")
_V = TypeVar("_V", bound="BaseServer[Any, Any]")
_H = TypeVar("_H")


class Node(Protocol):
    """Interface of a node to its session."""

    @property
    def core(self) -> SessionCore:
        """The core of the session."""

    def waiting_for(self) -> str:
        """Return what prevents the node from being attached."""

    def refused(self, name: Name) -> str:
        """Return why the overlay rejected an advertisement; empty if it did not."""

    def reload(self) -> None:
        """Read the delegations again."""

    def keep(self, topic: Topic, publisher: Publisher, holders: Sequence[Topic], most_bytes: int) -> Kept:
        """Keep what a publisher publishes from now on. Raises ``GdpError``: there is no folder for it."""

    def close(self) -> None:
        """Close the device."""


class Kept(Protocol):
    """Interface of the keeper of a session's topics."""

    def is_uploaded(self, topic: Name) -> bool:
        """Return whether each holder has confirmed all that was published."""

    def release(self, topic: Name) -> None:
        """Keep a topic no more."""


class BaseSession(Generic[_D, _P, _S, _V, _H]):
    """A session with a driver of type ``_D``, what it opens, and its handlers of requests."""

    _publisher_type: type[_P]
    _subscription_type: type[_S]
    _server_type: type[_V]

    def __init__(self, node: Node, driver: _D) -> None:
        self.core = node.core
        self.driver = driver
        self._node = node
        self._opened: list[Opened[_D]] = []
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
        paths: Paths = 1,
        deadline_s: float | None = None,
        weight: int = 1,
        max_bits_s: float | None = None,
        repairs: bool = True,
        own_pace: bool = False,
        keep: Sequence[NameLike] = (),
        keep_bytes: int = 10**9,
    ) -> _P:
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
            own_pace: without ``reliable``: each reader gets what its path carries; otherwise the slowest one governs.

            keep: services of holders that get all messages, in a capsule; they wait in ``state`` of the session until
                each has them, ``keep_bytes`` at most.

        Raises:
            DelegationError: the node may not publish it, or call a holder.
            LocalError: the session publishes it already, an option is out of bounds, or ``state`` is missing.
            StoreError: the disk refuses.
        """
        holders = [self.core.resolve(each, Right.CALL) for each in keep]
        topic = self.core.resolve(name, Right.PUBLISH)
        urgent = is_urgent(priority)
        options = SendOptions(
            deadline_s=deadline_s,
            weight=weight,
            max_bits_s=max_bits_s,
            repairs=repairs,
            own_pace=own_pace,
            priority=priority,
        )
        made = self.driver.run(
            lambda: self.core.member.advertise(
                topic,
                description,
                reliable=reliable,
                depth=latched,
                is_global=is_global,
                urgent=urgent,
                paths=paths_value(paths),
                options=checked(options),
            )
        )
        publisher = self._publisher_type(self, topic, made, reliable=reliable)
        if holders:
            try:
                publisher.kept = self.driver.run(lambda: self._node.keep(topic, made, holders, keep_bytes))
            except GdpError:
                publisher.close()
                raise
        self._opened.append(publisher)
        return publisher

    def subscribe(self, name: NameLike, *, queue: int = QUEUE_MESSAGES, paths: Paths = 1) -> _S:
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
        inbox = self.driver.run(lambda: self.core.subscribe(topic, queue, paths_value(paths)))
        subscription = self._subscription_type(self, topic, inbox)
        self._opened.append(subscription)
        return subscription

    def serve(
        self,
        name: NameLike,
        handler: _H,
        *,
        workers: int = 1,
        priority: Priority = "normal",
        is_global: bool = True,
        paths: Paths = 1,
        sign: Sign = "always",
    ) -> _V:
        """Serve a name: ``handler`` gets each request and returns the response.

        Args:
            name: as for ``publisher``.
            handler: called in a worker thread; with asyncio a coroutine function. If it raises, the client gets the
                error's text, and may call another server.
            workers: number of threads or tasks, and so of requests that are handled at the same time.
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
        server = self._server_type(self, topic, core, handler, workers)
        self._opened.append(server)
        return server

    def reload(self) -> None:
        """Read the delegations again: renewed ones and new names take effect without a message lost.

        Raises:
            LocalError: a file is malformed, or readable for others.
        """
        self.driver.run(self._node.reload)

    def why_not(self, name: Name, otherwise: str) -> str:
        """Return the end of an error's sentence: why no data flows on a name, as far as this node knows."""
        if not self.is_attached:
            return f"; the node is not attached: {self._node.waiting_for()}"
        refused = self._node.refused(name)
        return f"; the advertisement was refused: {refused}" if refused else f"; {otherwise}"

    def forget(self, opened: Opened[_D]) -> None:
        """Remove an object from the session's list after it closed itself."""
        if opened in self._opened:
            self._opened.remove(opened)

    def _new_call(
        self, name: NameLike, request: bytes, timeout_s: float | None, replication: str | int | Replication
    ) -> tuple[Topic, Call]:
        call = Call(payload=bytes(request), timeout_s=timeout_s, replication=replication_of(replication))
        if len(call.payload) > PAYLOAD_MAX_BYTES:
            raise LocalError(f"the request has {len(call.payload)} bytes; at most {PAYLOAD_MAX_BYTES} can be sent")
        return self.core.resolve(name, Right.CALL), call

    def _not_attached(self, timeout_s: float) -> AttachError:
        return AttachError(f"not attached within {timeout_s:g} s: {self._node.waiting_for()}")


class Opened(Generic[_D]):
    """An object that a session opened for one name."""

    def __init__(self, session: BaseSession[_D, Any, Any, Any, Any], topic: Topic) -> None:
        self._session = session
        self._driver = session.driver
        self._topic = topic
        self._is_closed = False

    @property
    def name(self) -> Name:
        """Return the 256-bit name."""
        return self._topic.name

    @property
    def _label(self) -> str:
        return self._session.core.label(self._topic)


class BasePublisher(Opened[_D]):
    """Publisher of one name."""

    def __init__(
        self, session: BaseSession[_D, Any, Any, Any, Any], topic: Topic, publisher: Publisher, *, reliable: bool
    ) -> None:
        super().__init__(session, topic)
        self._publisher = publisher
        self._is_reliable = reliable
        self.kept: Kept | None = None

    @property
    def readers(self) -> int:
        """Return the number of matched readers."""
        return self._publisher.readers

    @property
    def confirmed(self) -> int:
        """Return how many messages every reader has confirmed; readers confirm none that is best effort."""
        return self._publisher.acknowledgements.acknowledged if self._publisher.confirms else 0

    @property
    def sent(self) -> int:
        """Return how many messages have left this node, not counting those that some reader is known not to get."""
        return self._publisher.acknowledgements.sent

    @property
    def expired(self) -> int:
        """Return how many messages were dropped here, because they could not leave in time."""
        return self._publisher.losses.counts[LossReason.LIFESPAN]

    @property
    def reader_lost(self) -> int:
        """Return how many messages the reader that lost most reports as lost, those that never left included."""
        return self._publisher.acknowledgements.reader_lost

    @property
    def lost(self) -> int:
        """Return how many messages some reader did not get, as far as this node knows."""
        return self._publisher.losses.total

    @property
    def resent(self) -> int:
        """Return how many fragments were retransmitted because a reader lacked them."""
        return self._publisher.protection.repairs

    @property
    def can_restore(self) -> bool:
        """Return whether large messages get parity against loss: the rule allows it, and NumPy is installed."""
        return self._publisher.protection.parity.is_enabled and self._publisher.protection.parity.is_available

    @property
    def is_kept(self) -> bool:
        """Return whether each holder has confirmed all that was published; false without ``keep``."""
        kept = self.kept
        return kept is not None and self._driver.run(lambda: kept.is_uploaded(self.name))

    def close(self) -> None:
        """Stop publishing; unconfirmed messages are lost, so ``flush`` first. Idempotent."""
        if not self._is_closed:
            self._is_closed = True
            self._session.forget(self)
            if self.kept is not None:
                self._driver.run(partial(self.kept.release, self.name))
            self._driver.run(partial(self._session.core.member.withdraw, self.name))

    def _check(self, payload: bytes) -> None:
        """Return if a message may be published."""
        if self._is_closed:
            raise ClosedError(f"the publisher of {self._label} is closed; open a new one with session.publisher()")
        if len(payload) > PAYLOAD_MAX_BYTES:
            raise LocalError(f"{self._label}: {len(payload)} bytes; at most {PAYLOAD_MAX_BYTES} fit into one message")

    def _may_put(self) -> bool:
        """Return whether ``put`` need not wait any longer."""
        return self._publisher.has_space() or not self._publisher.is_wanted

    def _window_full(self, timeout_s: float | None) -> SessionTimeoutError:
        return SessionTimeoutError(
            f"{self._label}: the window was full for {timeout_s:g} s, since a reader confirms too slowly;"
            " publish less, or with reliable=False"
        )

    def _too_few_readers(self, count: int, timeout_s: float | None) -> SessionTimeoutError:
        hint = self._session.why_not(self.name, "start a program that subscribes to it")
        return SessionTimeoutError(f"{self._label}: {self.readers} of {count} reader(s) within {timeout_s:g} s{hint}")

    def _unconfirmed(self, timeout_s: float | None) -> SessionTimeoutError:
        return SessionTimeoutError(f"{self._label}: not every reader has confirmed within {timeout_s:g} s")


class BaseSubscription(Opened[_D]):
    """Messages of one name."""

    def __init__(self, session: BaseSession[_D, Any, Any, Any, Any], topic: Topic, inbox: Inbox) -> None:
        super().__init__(session, topic)
        self._inbox = inbox
        self._messages = inbox.messages

    @property
    def publishers(self) -> int:
        """Return the number of matched publishers."""
        return len(self._session.core.member.subscriptions.writer_proxies_of(self.name))

    @property
    def lost(self) -> int:
        """Return how many messages were lost on their way to this node."""
        return self._session.core.member.subscriptions.losses_of(self.name).total

    @property
    def dropped(self) -> int:
        """Return how many messages this node dropped because the program received too few."""
        return self._inbox.dropped

    def is_ready(self) -> bool:
        """Return whether ``receive`` would return, or raise, at once."""
        return bool(self._messages) or self._is_closed

    def close(self) -> None:
        """Unsubscribe. Idempotent."""
        if not self._is_closed:
            self._is_closed = True
            self._session.forget(self)
            self._driver.run(partial(self._session.core.unsubscribe, self._inbox))

    def _no_message(self, timeout_s: float | None) -> SessionTimeoutError:
        drops = self._session.core.member.subscriptions.drops
        unread = drops[DropReason.MALFORMED] + drops[DropReason.BAD_VERSION]
        foreign = f", and {unread} messages that no session sent" if unread else ""
        hint = self._session.why_not(self.name, f"{self.publishers} publisher(s) are there{foreign}")
        return SessionTimeoutError(f"{self._label}: no message within {timeout_s:g} s{hint}")

    def _closed(self) -> ClosedError:
        return ClosedError(f"the subscription to {self._label} is closed; subscribe again")


class BaseServer(Opened[_D], Generic[_D, _H], ABC):
    """Server of one name with ``workers`` that call a handler."""

    def __init__(
        self, session: BaseSession[_D, Any, Any, Any, Any], topic: Topic, server: ServerCore, handler: _H, workers: int
    ) -> None:
        super().__init__(session, topic)
        self._core = server
        self._handler = handler
        self._start(workers)

    @abstractmethod
    def _start(self, workers: int) -> None:
        """Start the workers."""

    @property
    def clients(self) -> int:
        """Return the number of clients."""
        return self._core.clients
