"""Core of a session: it connects a participant of the overlay with queues of messages, servers and clients.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A driver passes frames to the participant, calls ``handle``
after each step, and wakes the callers whose condition has come true.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Final, Protocol

from gdp.client.participant import Message as MemberMessage
from gdp.client.participant import Participant, ServiceOptions, Topic
from gdp.due_queue import earliest
from gdp.errors import LocalError, RemoteError
from gdp.metadata import Metadata
from gdp.names import NAME_BYTES, Name
from gdp.service.replication import Mode, Replication
from gdp.session.protocol.client_core import Call, ClientCore
from gdp.session.protocol.errors import DelegationError
from gdp.session.protocol.messages import DelegatedName, Message, NameLike, describe
from gdp.session.protocol.nearest_holder import NearestHolder
from gdp.session.protocol.server_core import ServerCore
from gdp.session.protocol.wire import read_message
from gdp.trust.right import Right

if TYPE_CHECKING:
    from typing_extensions import Unpack

QUEUE_MESSAGES: Final = 1_024
QUEUE_MAX_BYTES: Final = 64 << 20
_HEX: Final = frozenset("0123456789abcdefABCDEF")


class _Receiver(Protocol):
    """Receiver of the participant's messages of one name."""

    def receive(self, message: MemberMessage, now_s: float) -> None:
        """Process one message; raises ``RemoteError`` if it is malformed."""


class _Service(Protocol):
    """What has timers of its own."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""

    def handle_timer(self, now_s: float) -> None:
        """Handle the timers that are due."""


class _Keeper(_Receiver, _Service, Protocol):
    """What calls holders of history, and gets their messages."""


class Inbox:
    """Messages of one subscription that the program has not received yet.

    Args:
        limit: most messages that wait; beyond it the oldest one is dropped and counted.

    Attributes:
        messages: the waiting messages, the oldest first.
    """

    def __init__(self, name: Name, limit: int) -> None:
        self.name = name
        self.messages: deque[Message] = deque()
        self.dropped = 0
        self._limit = limit
        self._bytes = 0  # of all added messages, minus the dropped ones; recounted near the bound

    def receive(self, message: MemberMessage, now_s: float) -> None:
        """Add a message. Raises ``RemoteError``: MALFORMED or BAD_VERSION."""
        del now_s
        delivered = message.delivered
        stamp_ns, payload = read_message(delivered.message)
        publisher = delivered.publisher
        if not isinstance(publisher, Name):
            publisher = Name(publisher)
        messages = self.messages
        messages.append(Message(payload, publisher, delivered.sequence, delivered.hops, stamp_ns))
        self._bytes += len(payload)
        if len(messages) > self._limit or self._bytes > QUEUE_MAX_BYTES:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        messages = self.messages
        if self._bytes > QUEUE_MAX_BYTES:
            # without the messages that the program has received
            self._bytes = sum(len(each.payload) for each in list(messages))
        while len(messages) > self._limit or (self._bytes > QUEUE_MAX_BYTES and len(messages) > 1):
            try:
                self._bytes -= len(messages.popleft().payload)
            except IndexError:  # the program received the last one in the meantime
                return
            self.dropped += 1


class SessionCore:
    """One session over one participant.

    Args:
        topics: the delegations of the node.
        random_start: returns 64 random bits, for the numbers of calls.
        delegations_at: location of the delegations, for errors.
    """

    def __init__(
        self,
        member: Participant,
        topics: Iterable[Topic],
        random_start: Callable[[], int],
        delegations_at: str = "its delegations",
    ) -> None:
        self.member = member
        self._topics = {topic.name: topic for topic in topics}
        self._random_start = random_start
        self._delegations_at = delegations_at
        self._receivers: dict[Name, _Receiver] = {}  # by a name that is read, served or called
        self._clients: dict[Name, ClientCore] = {}
        self._servers: dict[Name, ServerCore] = {}
        self._services: list[_Service] = []

    # names

    @property
    def delegations(self) -> list[DelegatedName]:
        """Return the names that the node holds delegations for."""
        found = (topic.delegation for topic in self._topics.values())
        return [DelegatedName(each.name, each.rights, each.metadata) for each in found]

    def resolve(self, name: NameLike, right: Right) -> Topic:
        """Return the delegation for a name.

        Raises:
            DelegationError: no delegation gives this right, or several do.
        """
        found = [topic for topic in self._topics.values() if _is_meant(topic, name)]
        allowed = [topic for topic in found if right in topic.delegation.rights]
        if len(allowed) == 1:
            return allowed[0]
        shown = _shown(name)
        if allowed:
            names = ", ".join(topic.name.to_text() for topic in allowed)
            raise DelegationError(f"{shown}: {len(allowed)} delegations fit; give the metadata or one of {names}")
        raise DelegationError(
            f"{shown}: no delegation to {right.value} it in {self._delegations_at}, which has"
            f" {describe(self.delegations)}; its owner makes one with 'gdp delegate name --right {right.value}', and"
            " 'gdp delegate install' adds it"
        )

    def label(self, topic: Topic) -> str:
        """Return the word for a name in errors and logs."""
        delegation = topic.delegation
        return DelegatedName(delegation.name, delegation.rights, delegation.metadata).label

    def renew(self, topics: Iterable[Topic]) -> None:
        """Replace the delegations: new epochs, longer validity and new names take effect."""
        self._topics = {topic.name: topic for topic in topics}
        for topic in self._topics.values():
            self.member.renew(topic)

    # calls of a program

    def subscribe(self, topic: Topic, limit: int, paths: int = 1) -> Inbox:
        """Subscribe to a name. Raises ``LocalError``: the name is read, served or called already in this session."""
        self.member.subscribe(topic, paths=paths)
        inbox = self._receivers[topic.name] = Inbox(topic.name, limit)
        return inbox

    def unsubscribe(self, inbox: Inbox) -> None:
        """Unsubscribe from a name."""
        if self._receivers.get(inbox.name) is inbox:
            del self._receivers[inbox.name]
            self.member.unsubscribe(inbox.name)

    def serve(self, topic: Topic, *, at_once: int | None, **options: Unpack[ServiceOptions]) -> ServerCore:
        """Serve a name. Raises ``LocalError``: the name is read, served or called already in this session."""
        server = ServerCore(self.member, topic, start=self._random_start(), at_once=at_once, **options)
        self._receivers[topic.name] = self._servers[topic.name] = server
        self._services.append(server)
        return server

    def close_server(self, server: ServerCore, now_s: float) -> None:
        """Stop serving a name; active requests fail."""
        for name in [name for name, each in self._servers.items() if each is server]:
            del self._servers[name], self._receivers[name]
            self._services.remove(server)
            server.close(now_s)

    def call(self, topic: Topic, call: Call, now_s: float, paths: int = 1, *, is_session: bool = False) -> None:
        """Begin a call; the first call on a name advertises that this node calls it, and its options.

        Raises:
            LocalError: the name is read or served already in this session.
        """
        self.client(topic, paths, is_session=is_session).begin(call, now_s)

    def client(self, topic: Topic, paths: int = 1, *, is_session: bool = False) -> ClientCore:
        """Return the client of a name. Raises ``LocalError``: as for ``call``."""
        client = self._clients.get(topic.name)
        if client is None:
            client = ClientCore(
                self.member,
                topic,
                self.label(topic),
                start=self._random_start(),
                paths=paths,
                is_session=is_session,
            )
            self._receivers[topic.name] = self._clients[topic.name] = client
            self._services.append(client)
        return client

    def nearest_holder(self, services: Iterable[str]) -> NearestHolder:
        """Return a reading at the nearest of several holders. Raises ``LocalError``: as for ``resolve``, ``call``."""
        holder = NearestHolder({each: self.client(self.resolve(each, Right.CALL)) for each in services})
        self._services.append(holder)
        return holder

    def add_service(self, service: _Keeper, names: Iterable[Name]) -> None:
        """Have a keeper handled, and get what comes on the names that it calls."""
        self._receivers.update(dict.fromkeys(names, service))
        if service not in self._services:
            self._services.append(service)

    def close(self, now_s: float) -> None:
        """Close everything, and send a goodbye."""
        for server in list(self._servers.values()):
            self.close_server(server, now_s)
        for client in self._clients.values():
            client.close()
        self._receivers.clear()
        self._clients.clear()
        self._services.clear()
        self.member.leave()

    # calls of a driver

    @property
    def has_services(self) -> bool:
        """Return whether a name is served or called."""
        return bool(self._services)

    def handle(self, now_s: float) -> None:
        """Distribute the received messages, and handle the timers that are due."""
        for message in self.member.poll_messages():
            receiver = self._receivers.get(message.topic)
            if receiver is None:
                continue  # it arrived during the close of its subscription
            try:
                receiver.receive(message, now_s)
            except RemoteError as error:
                self.member.subscriptions.drops[error.reason] += 1
        for service in self._services:
            due_s = service.get_timer()
            if due_s is not None and now_s >= due_s:
                service.handle_timer(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer beyond the participant's own, or None."""
        return earliest(*[service.get_timer() for service in self._services]) if self._services else None


def replication_of(value: str | int | Replication) -> Replication:
    """Return how a request is replicated.

    Args:
        value: ``"all"``, ``"hedged"``, ``"nearest"``, the number of servers that get a copy, or a ``Replication``.

    Raises:
        LocalError: none of these.
    """
    if isinstance(value, Replication):
        return value
    if isinstance(value, int) and not isinstance(value, bool) and value >= 1:
        return Replication(Mode.SOME, copies=value)
    if value in ("all", "hedged", "nearest"):
        return Replication(Mode(value))
    raise LocalError(f"replication is 'all', 'hedged', 'nearest' or a number of servers from 1, not {value!r}")


def _is_meant(topic: Topic, name: NameLike) -> bool:
    metadata = topic.delegation.metadata
    if isinstance(name, Metadata):
        return name.name(topic.delegation.subject.owner_key) == topic.name
    if isinstance(name, Name):
        return name == topic.name
    if len(name) == 2 * NAME_BYTES and _HEX.issuperset(name):
        return name.lower() == topic.name.to_text()
    meant = None if metadata is None else metadata.get("name")
    return isinstance(meant, str) and meant.lstrip("/") == name.lstrip("/")


def _shown(name: NameLike) -> str:
    if isinstance(name, Metadata):
        return str(name.get("name", name))
    return name.short if isinstance(name, Name) else name
