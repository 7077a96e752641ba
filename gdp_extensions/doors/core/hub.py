"""Hub of a door: what the bridge offers, what the clients want, and the messages between them.

Sans-I/O; ``endpoint.py`` runs it in the thread of the WebSocket server. The bridge's side are the methods of an
endpoint. The clients' side are sessions, one for each connection, which implement a protocol.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import count
from typing import Final, Protocol, TypeAlias

from gdp_extensions.doors.core.client_queue import ClientQueue, Pending
from proxy.bridge.core.delegated_rules import DelegatedRules
from proxy.endpoints.core.endpoint import (
    Event,
    Graph,
    GraphChanged,
    GraphEntity,
    MessageReceived,
    RequestReceived,
    Role,
    TypeResolved,
)
from proxy.endpoints.core.qos import DEPTH_MAX, default, depth_of
from proxy.serial.channel import Channel, Service

REASON_MAX: Final = 4_096  # characters of an error that a client hears: it may repeat what the client sent
REPLACED_S: Final = 0.5  # a publisher that is closed and opened again within this time keeps its number
_EARLY_MAX: Final = 64
_EARLY_MAX_BYTES: Final = 16 << 20  # of all topics
_HIDDEN: Final = "/_gdp_proxy"  # presence topics of proxies

TopicType: TypeAlias = "tuple[str, str]"


@dataclass(slots=True, eq=False)
class Publication:
    """A topic that the bridge publishes to the clients.

    Args:
        number: the same for as long as the topic is offered with one definition.
        kept: the last messages of a latched topic, with their stamps.
    """

    number: int
    channel: Channel
    kept: deque[tuple[int, bytes]]
    closed_at_s: float | None = None
    _encoded: tuple[bytes, bytes] = (b"", b"")

    def encoded(self, raw: bytes, encode: Callable[[bytes], bytes]) -> bytes:
        """Return another form of a message; that of the latest one is kept, since all clients need it."""
        if self._encoded[0] is not raw:
            self._encoded = (raw, encode(raw))
        return self._encoded[1]

    @property
    def identity(self) -> tuple[str, str, str]:
        """Return what makes two publications the same to a client."""
        return self.channel.topic, self.channel.type_name, self.channel.definition


class DoorSession(Protocol):
    """One client's connection.

    Attributes:
        number: never reused.
        queue: what waits to be sent.
    """

    number: int
    queue: ClientQueue

    def handle_message(self, data: str | bytes, now_ns: int) -> None:
        """Process a message of the client. Raises ``RemoteError``: it is malformed, and was ignored."""

    def tell_wrong(self, reason: str) -> None:
        """Report to the client what it did wrong."""

    def tell_dropped(self, total: int) -> None:
        """Report to the client how many messages were dropped because it reads too slowly."""

    def encode(self, pending: Pending) -> str | bytes:
        """Return the wire form of a message of a subscription."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of the session's next timer, or None."""

    def handle_timer(self, now_s: float) -> None:
        """Run a due timer."""

    def reads(self) -> Iterable[TopicType]:
        """Return the topics that the client reads."""

    def publishes(self) -> Iterable[TopicType]:
        """Return the topics that the client publishes."""

    def schema_of(self, topic: str, type_name: str) -> Channel | None:
        """Return the client's own description of a topic that it publishes."""

    def add_publication(self, publication: Publication) -> None:
        """Offer a topic."""

    def remove_publication(self, publication: Publication) -> None:
        """Withdraw a topic."""

    def queue_message(self, publication: Publication, stamp_ns: int, raw: bytes) -> None:
        """Queue a message for the client's subscriptions to it."""

    def add_service(self, handle: int, service: Service) -> None:
        """Offer a service."""

    def remove_service(self, handle: int, service: Service) -> None:
        """Withdraw a service."""

    def pass_answer(self, context: object, raw: bytes) -> None:
        """Pass on the response to a request."""

    def pass_refusal(self, context: object, reason: str) -> None:
        """Pass on why a request has no response."""


@dataclass(slots=True, eq=False)
class _Call:
    session: DoorSession
    handle: int
    context: object


@dataclass(slots=True)
class Hub:
    """All state of one door.

    Args:
        emit: gets the events for the bridge.
        rights: returns the present rights, which change when delegations are read again.
        known: returns this machine's description of a topic type; raises ``LocalError`` where it has none.

    Attributes:
        graph: the clients, as the bridge sees them.
        sessions: by number.
    """

    emit: Callable[[Event], None]
    rights: Callable[[], DelegatedRules]
    known: Callable[[str, str], Channel | None]
    graph: Graph = frozenset()
    sessions: dict[int, DoorSession] = field(default_factory=dict)
    publications: dict[int, Publication] = field(default_factory=dict)  # by handle
    services: dict[int, Service] = field(default_factory=dict)  # by handle
    _replaced: list[Publication] = field(default_factory=list)
    _inputs: dict[int, TopicType] = field(default_factory=dict)  # the bridge's subscriptions, by handle
    _resolved: set[int] = field(default_factory=set)
    _undescribed: set[TopicType] = field(default_factory=set)
    _calls: dict[int, _Call] = field(default_factory=dict)  # by ticket
    _numbers: count[int] = field(default_factory=lambda: count(1))
    _early: dict[TopicType, deque[tuple[int, bytes]]] = field(default_factory=dict)
    dropped_otherwise: int = 0  # for clients that are gone, or of clients before the bridge took their topic

    # the bridge's side

    def want_definition(self, topic: str, type_name: str) -> None:
        """Read a topic until a publisher's definition is known: without one, no client could learn of it."""
        if (topic, type_name) not in self._undescribed:
            self._undescribed.add((topic, type_name))
            self.update_graph()

    def offer_topic(self, handle: int, channel: Channel) -> None:
        """Offer a topic to the clients."""
        if channel.topic.startswith(_HIDDEN):
            return
        self._undescribed.discard((channel.topic, channel.type_name))
        keeps = min(depth_of(channel.qos[0]) if channel.qos else 1, DEPTH_MAX) if channel.latched else 0
        new = Publication(next(self._numbers), channel, deque(maxlen=keeps))
        for old in [each for each in self._replaced if each.identity == new.identity]:
            self._replaced.remove(old)
            old.channel, old.kept, old.closed_at_s = channel, new.kept, None
            self.publications[handle] = old
            self.update_graph()
            return
        self.publications[handle] = new
        for session in self.sessions.values():
            session.add_publication(new)
        self.update_graph()

    def pass_message(self, handle: int, stamp_ns: int, raw: bytes) -> None:
        """Pass a message to the clients that read its topic."""
        publication = self.publications.get(handle)
        if publication is None:
            return  # closed a moment ago
        publication.kept.append((stamp_ns, raw))
        for session in self.sessions.values():
            session.queue_message(publication, stamp_ns, raw)

    def offer_service(self, handle: int, service: Service) -> None:
        """Offer a service to the clients."""
        self.services[handle] = service
        for session in self.sessions.values():
            session.add_service(handle, service)

    def pass_answer(self, ticket: int, raw: bytes) -> None:
        """Pass on a response; an unknown ticket is ignored: its client is gone."""
        call = self._calls.pop(ticket, None)
        if call is not None:
            call.session.pass_answer(call.context, raw)

    def pass_refusal(self, ticket: int, reason: str) -> None:
        """Pass on why a request has no response."""
        call = self._calls.pop(ticket, None)
        if call is not None:
            call.session.pass_refusal(call.context, reason)

    def take_topic(self, handle: int, topic: str, type_name: str) -> None:
        """Begin to take what clients publish under a name."""
        self._inputs[handle] = (topic, type_name)
        self._resolve()
        for stamp_ns, raw in self._early.pop((topic, type_name), ()):
            self.emit(MessageReceived(handle, stamp_ns, raw))

    def close(self, handle: int, now_s: float) -> None:
        """End a publisher, a server or a subscription."""
        self._inputs.pop(handle, None)
        self._resolved.discard(handle)
        if (publication := self.publications.pop(handle, None)) is not None:
            publication.closed_at_s = now_s
            self._replaced.append(publication)
        if (service := self.services.pop(handle, None)) is not None:
            for ticket in [ticket for ticket, call in self._calls.items() if call.handle == handle]:
                self.pass_refusal(ticket, f"{service.name}: its last server is gone")
            for session in self.sessions.values():
                session.remove_service(handle, service)

    def handle_timer(self, now_s: float) -> None:
        """Withdraw the topics whose publisher was not replaced."""
        gone = [each for each in self._replaced if now_s >= (each.closed_at_s or 0.0) + REPLACED_S]
        for publication in gone:
            self._replaced.remove(publication)
            for session in self.sessions.values():
                session.remove_publication(publication)
        for session in self.sessions.values():
            session.handle_timer(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [(each.closed_at_s or 0.0) + REPLACED_S for each in self._replaced]
        times += [time for session in self.sessions.values() if (time := session.get_timer()) is not None]
        return min(times, default=None)

    def channel_of(self, topic: str, type_name: str) -> Channel | None:
        """Return the description of a topic that clients publish: this machine's, or a client's; None: unknown."""
        theirs = (each.schema_of(topic, type_name) for each in self.sessions.values())
        return self.known(topic, type_name) or next((each for each in theirs if each is not None), None)

    def server_of(self, name: str) -> int | None:
        """Return the handle of a service that has a server; None: it has none."""
        return next((handle for handle, each in self.services.items() if each.name == name), None)

    @property
    def offered(self) -> list[Publication]:
        """Return the topics that clients may read now."""
        return [*self.publications.values(), *self._replaced]

    # the clients' side

    def open(self, session: DoorSession) -> None:
        """Add a client; offer it everything."""
        self.sessions[session.number] = session
        for publication in self.offered:
            session.add_publication(publication)
        for handle, service in self.services.items():
            session.add_service(handle, service)

    def end(self, session: DoorSession) -> None:
        """Remove a client; responses to its requests are ignored."""
        del self.sessions[session.number]
        self.dropped_otherwise += session.queue.dropped
        self._calls = {ticket: call for ticket, call in self._calls.items() if call.session is not session}
        self.update_graph()

    def request(self, session: DoorSession, handle: int, context: object, raw: bytes) -> None:
        """Pass a request to the bridge; ``DoorSession.pass_answer`` or ``pass_refusal`` follows with the context."""
        ticket = next(self._numbers)
        self._calls[ticket] = _Call(session, handle, context)
        self.emit(RequestReceived(handle, ticket, raw))

    def input(self, topic: str, type_name: str, stamp_ns: int, raw: bytes) -> None:
        """Pass on a message of a client, to the door's other clients too; the first wait until the bridge takes it."""
        for handle, publication in self.publications.items():
            if (publication.channel.topic, publication.channel.type_name) == (topic, type_name):
                self.pass_message(handle, stamp_ns, raw)
        handles = [handle for handle, wanted in self._inputs.items() if wanted == (topic, type_name)]
        for handle in handles:
            self.emit(MessageReceived(handle, stamp_ns, raw))
        if not handles:
            early = self._early.setdefault((topic, type_name), deque())
            early.append((stamp_ns, raw))
            waiting_bytes = sum(len(each) for kept in self._early.values() for _, each in kept)
            while early and (len(early) > _EARLY_MAX or waiting_bytes > _EARLY_MAX_BYTES):
                waiting_bytes -= len(early.popleft()[1])
                self.dropped_otherwise += 1

    def update_graph(self) -> None:
        """Tell the bridge what the clients read and publish, if that has changed."""
        ends = set[GraphEntity]()
        for session in self.sessions.values():
            node = f"/client_{session.number}"
            for role, things in ((Role.SUBSCRIBES, session.reads()), (Role.PUBLISHES, session.publishes())):
                qos = default() if role is Role.PUBLISHES else None
                ends |= {GraphEntity(role, *each, node, f"{node}:{role.value}:{each}", qos=qos) for each in things}
        published = {(end.name, end.type_name) for end in ends if end.role is Role.PUBLISHES}
        self._early = {each: early for each, early in self._early.items() if each in published}
        ends |= {GraphEntity(Role.SUBSCRIBES, *each, "/door", f"definition:{each}") for each in self._undescribed}
        self._resolve()
        if (graph := frozenset(ends)) != self.graph:
            self.graph = graph
            self.emit(GraphChanged())

    @property
    def dropped(self) -> int:
        """Return the messages dropped because a queue was full, including those of closed connections."""
        return self.dropped_otherwise + sum(session.queue.dropped for session in self.sessions.values())

    def _resolve(self) -> None:
        """Tell the bridge the type of each topic that it takes, once it is known here or by a client."""
        for handle, (topic, type_name) in self._inputs.items():
            if handle in self._resolved:
                continue
            channel = self.channel_of(topic, type_name)
            if channel is not None:
                self._resolved.add(handle)
                self.emit(TypeResolved(handle, channel))
