"""State that sessions for threads and for asyncio have in common: what they opened, its counters, its errors.

Sans-I/O; ``session.py`` and ``aio.py`` add the calls that wait.
"""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher
from gdp.errors import LocalError
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.service.replication import Replication
from gdp.session.protocol.client_core import Call
from gdp.session.protocol.core import Inbox, SessionCore, replication_of
from gdp.session.protocol.errors import AttachError, ClosedError, SessionTimeoutError
from gdp.session.protocol.messages import DelegatedName, NameLike
from gdp.session.protocol.server_core import ServerCore
from gdp.session.protocol.wire import PAYLOAD_MAX_BYTES
from gdp.trust.right import Right

__all__ = ["BasePublisher", "BaseServer", "BaseSession", "BaseSubscription", "Node", "Opened"]

_D = TypeVar("_D")


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

    def close(self) -> None:
        """Close the device."""


class BaseSession(Generic[_D]):
    """A session with a driver of type ``_D``."""

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

    def __init__(self, session: BaseSession[_D], topic: Topic) -> None:
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

    def __init__(self, session: BaseSession[_D], topic: Topic, publisher: Publisher, *, reliable: bool) -> None:
        super().__init__(session, topic)
        self._publisher = publisher
        self._is_reliable = reliable

    @property
    def readers(self) -> int:
        """Return the number of matched readers."""
        return self._publisher.readers

    @property
    def confirmed(self) -> int:
        """Return how many messages every reader has confirmed; readers confirm none that is best effort."""
        return self._publisher.acknowledged if self._publisher.confirms else 0

    @property
    def sent(self) -> int:
        """Return how many messages have left this node, not counting those that some reader is known not to get."""
        return self._publisher.sent

    @property
    def expired(self) -> int:
        """Return how many messages were dropped here, because they could not leave in time."""
        return self._publisher.losses.counts[LossReason.LIFESPAN]

    @property
    def reader_lost(self) -> int:
        """Return how many messages the reader that lost most reports as lost, those that never left included."""
        return self._publisher.reader_lost

    @property
    def lost(self) -> int:
        """Return how many messages some reader did not get, as far as this node knows."""
        return self._publisher.losses.total

    @property
    def resent(self) -> int:
        """Return how many fragments were retransmitted because a reader lacked them."""
        return self._publisher.repairs

    @property
    def can_restore(self) -> bool:
        """Return whether large messages get parity against loss: the rule allows it, and NumPy is installed."""
        return self._publisher.parity.is_enabled and self._publisher.parity.is_available

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

    def __init__(self, session: BaseSession[_D], topic: Topic, inbox: Inbox) -> None:
        super().__init__(session, topic)
        self._inbox = inbox
        self._messages = inbox.messages

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

    def is_ready(self) -> bool:
        """Return whether ``receive`` would return, or raise, at once."""
        return bool(self._messages) or self._is_closed

    def _no_message(self, timeout_s: float | None) -> SessionTimeoutError:
        hint = self._session.why_not(self.name, f"{self.publishers} publisher(s) are there")
        return SessionTimeoutError(f"{self._label}: no message within {timeout_s:g} s{hint}")

    def _closed(self) -> ClosedError:
        return ClosedError(f"the subscription to {self._label} is closed; subscribe again")


class BaseServer(Opened[_D]):
    """Server of one name."""

    def __init__(self, session: BaseSession[_D], topic: Topic, server: ServerCore) -> None:
        super().__init__(session, topic)
        self._core = server

    @property
    def clients(self) -> int:
        """Return the number of clients."""
        return self._core.clients
