"""A far server on its way in: a virtual server here, each request sent out under a number of its own.

Place: shell; endpoint and member do the I/O. The virtual server stands while a far one is heard, so that local clients
see whether there is one. A call ends with the first answer, with a reason, or when its time is up; a later answer
finds nobody.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from gdp.client.member import Message, Topic
from gdp.errors import GdpError, LocalError, RemoteError
from gdp.names import Name
from gdp.service.calls import Calls
from proxy.bridge.incoming import Incoming
from proxy.bridge.parts import PROFILES, RESULT, Parts
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Wish
from proxy.endpoints.endpoint import Asked, Event, Faulted
from proxy.exchange import PATIENCE_MAX_MS, Answer, Exchange, News, Outcome, Request, too_large
from proxy.faults import Fault
from proxy.serial.channel import Channel
from proxy.serial.serializer import Serializer
from proxy.serial.service import Service
from proxy.serial.service_twin import twin_service
from proxy.serial.twin import twin_channel

__all__ = ["ImportedService"]

_CALLS_MAX = 65_536  # under way from this machine
_GONE = "the far server is gone"


class _Waiting(NamedTuple):
    """A local client's request."""

    part: int
    ticket: int


class _Server(NamedTuple):
    """A far server's dialect, by part."""

    description: bytes
    answers: tuple[Incoming, ...]
    news: tuple[Incoming, ...]


class ImportedService:
    """Lets local clients call one far service or action.

    Args:
        random_start: the first number of a call, random.
    """

    def __init__(self, site: Site, seat: Seat, wish: Wish, topic: Topic, random_start: int) -> None:
        self._site = site
        self._seat = seat
        self._wish = wish
        self._topic = topic
        self._parts = Parts.of(wish.rule.kind, wish.local, wish.type_name)
        self._calls: Calls[_Waiting] = Calls(_CALLS_MAX, random_start)
        self._left: dict[int, set[Name]] = {}  # call -> servers that may still answer it
        self._servers: dict[Name, _Server] = {}
        self._requests: tuple[Serializer, ...] = ()
        self._handles: list[int] = []
        self._topics: list[int] = []
        self._publisher = site.member.call(
            topic, self._description(), is_global=wish.rule.is_global, urgent=wish.rule.priority == "urgent"
        )

    def receive(self, message: Message, now_s: float) -> None:
        """Take a far server's answer, or what its action's topics say."""
        del now_s
        self._site.traffic.received(len(message.delivered.message))
        try:
            if message.private:
                self._take_answer(message)
            else:
                self._take_news(message)
        except RemoteError as error:
            self._site.faults.tell(self._wish.local, Fault.MALFORMED, str(error))

    def take(self, event: Event, now_s: float) -> None:
        """Take a local client's request."""
        if isinstance(event, Asked):
            self._ask(event, now_s)
        elif isinstance(event, Faulted):
            self._site.tell(self._wish.local, event, Fault.REFUSED)

    def tick(self, now_s: float) -> None:
        """Open or close the virtual server as far ones come and go; fail what waited too long."""
        self._follow()
        for number, waiting in self._calls.expired(now_s):
            self._left.pop(number, None)
            self._refuse(waiting, Fault.TIMED_OUT, f"no answer within {self._wish.rule.timeout_s:g} s")

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._calls.next_timeout()

    def close(self, now_s: float) -> None:
        """Call nobody any more; calls under way fail."""
        del now_s
        self._shut("the proxy no longer carries this service")
        self._site.member.withdraw(self._topic.name)

    def renew(self, topic: Topic) -> None:
        """Take the delegation anew."""
        self._topic = topic
        self._site.member.renew(topic)

    def _follow(self) -> None:
        peers = self._site.member.peers(self._topic.name)
        feeds = self._site.member.feeds_of(self._topic.name) if peers else []
        descriptions = {feed.publisher: feed.description for feed in feeds if feed.publisher in peers}
        for name in [name for name, each in self._servers.items() if descriptions.get(name) != each.description]:
            del self._servers[name]
            for call in [call for call, left in self._left.items() if name in left]:
                self._rule_out(name, call, Fault.NO_SERVER, _GONE)
        for name, description in descriptions.items():
            if name not in self._servers:
                self._learn(name, description)
        if not self._servers and self._handles:
            self._shut(_GONE)

    def _learn(self, name: Name, description: bytes) -> None:
        """Make ready for a server's answers; the first one opens the virtual server here."""
        what, ros = self._wish.local, self._seat.endpoint.ros
        try:
            theirs = Exchange.from_wire(description)
            types = [*(each.type_name for each in theirs.services), *(each.type_name for each in theirs.topics)]
            if types != [type_name for _, type_name in (*self._parts.services, *self._parts.topics)]:
                raise LocalError(f"the far side serves something else under this name: {', '.join(types)}")
            ours = self._ours(theirs)
            services, topics = zip(theirs.services, ours.services, strict=True), zip(
                theirs.topics, ours.topics, strict=True
            )
            server = _Server(
                description,
                tuple(Incoming.ready(a.response, theirs.encoding, b.response, ros) for a, b in services),
                tuple(Incoming.ready(a, theirs.encoding, b, ros) for a, b in topics),
            )
            for our, their in zip(ours.services, theirs.services, strict=True):
                Incoming.ready(our.request, ours.encoding, their.request, theirs.services[0].ros)  # or it says why not
            if not self._handles:
                self._open(ours)
        except GdpError as error:
            self._site.faults.tell(what, Fault.OTHER_TYPE, str(error))
            server = _Server(description, (), ())
        self._servers[name] = server

    def _description(self) -> bytes:
        """Return how this machine knows the service; empty where it must learn that from the far side."""
        try:
            exchange = self._parts.known(self._seat.endpoint, self._wish.rule.encoding)
        except LocalError:
            return b""
        return exchange.to_wire()

    def _ours(self, theirs: Exchange) -> Exchange:
        """Return how this machine knows the service, from the far side's definitions where it does not by itself.

        Raises:
            LocalError: it cannot be known here.
        """
        endpoint = self._seat.endpoint
        services = list[Service]()
        for (name, type_name), their in zip(self._parts.services, theirs.services, strict=True):
            try:
                services.append(endpoint.service(name, type_name))
            except LocalError:
                same = their if their.ros == endpoint.ros else twin_service(their, endpoint.ros)
                services.append(replace(same, name=name))
        topics = list[Channel]()
        for (name, type_name), channel in zip(self._parts.topics, theirs.topics, strict=True):
            try:
                topics.append(endpoint.channel(name, type_name))
            except LocalError:
                same_channel = channel if channel.ros == endpoint.ros else twin_channel(channel, endpoint.ros)
                topics.append(replace(same_channel, topic=name))
        return Exchange(self._wish.rule.encoding, tuple(services), tuple(topics))

    def _open(self, ours: Exchange) -> None:
        self._publisher.describe(ours.to_wire())
        self._requests = tuple(Serializer(each.request, ours.encoding) for each in ours.services)
        self._topics = [
            self._seat.advertise(self, replace(each, qos=(profile,), latched=profile.durability == "transient_local"))
            for each, profile in zip(ours.topics, PROFILES, strict=False)
        ]
        self._handles = [self._seat.serve(self, each) for each in ours.services]

    def _shut(self, reason: str) -> None:
        for _, waiting in self._calls.fail_all():
            self._refuse(waiting, Fault.NO_SERVER, reason)
        self._left.clear()
        for handle in [*self._handles, *self._topics]:
            self._seat.close(handle)
        self._handles, self._topics = [], []

    def _ask(self, event: Asked, now_s: float) -> None:
        part = self._handles.index(event.handle)
        waiting = _Waiting(part, event.ticket)
        timeout_s = self._wish.rule.timeout_s
        if part == RESULT and self._wish.rule.kind == "action":
            timeout_s = None
        body = self._requests[part].encode(event.raw)
        if reason := too_large("a request", len(event.raw), self._wish.rule.max_bytes, len(body)):
            self._refuse(waiting, Fault.TOO_LARGE, reason)
            return
        if not self._publisher.has_room():
            self._refuse(waiting, Fault.TOO_FAST, "requests come faster than far servers confirm them")
            return
        try:
            number = self._calls.begin(now_s, timeout_s, waiting)
        except LocalError as error:
            self._refuse(waiting, Fault.TOO_FAST, str(error))
            return
        self._left[number] = {name for name, server in self._servers.items() if server.answers}
        patience_ms = 0 if timeout_s is None else min(max(int(timeout_s * 1e3), 1), PATIENCE_MAX_MS)
        wire = Request(part, number, patience_ms, body).to_wire()
        self._publisher.publish(wire)
        self._site.traffic.sent(len(wire))

    def _take_answer(self, message: Message) -> None:
        answer, name = Answer.from_wire(message.delivered.message), Name(message.delivered.publisher)
        server = self._servers.get(name)
        if server is None or answer.part >= len(server.answers):
            return  # of a server that is gone, or that cannot be understood here: that was told
        if answer.outcome is Outcome.FAILED:
            self._rule_out(name, answer.call, Fault.REFUSED, answer.reason)
            return
        try:
            raw = server.answers[answer.part].decode(answer.body)
        except RemoteError as error:
            self._rule_out(name, answer.call, Fault.MALFORMED, str(error))
            return
        waiting = self._calls.answered(answer.call)
        self._left.pop(answer.call, None)
        if waiting is not None:
            self._seat.endpoint.answer(self._handles[waiting.part], waiting.ticket, raw)

    def _rule_out(self, name: Name, call: int, fault: Fault, reason: str) -> None:
        """Learn that a server will not answer a call, which fails if no other may."""
        left = self._left.get(call, set())
        left.discard(name)
        if left:
            return
        self._left.pop(call, None)
        waiting = self._calls.answered(call)
        if waiting is not None:
            self._refuse(waiting, fault, reason)

    def _take_news(self, message: Message) -> None:
        news = News.from_wire(message.delivered.message)
        server = self._servers.get(Name(message.delivered.publisher))
        at = news.part - len(self._parts.services)
        if server is not None and 0 <= at < len(server.news) and self._topics:
            self._seat.endpoint.publish(self._topics[at], server.news[at].decode(news.body))

    def _refuse(self, waiting: _Waiting, fault: Fault, reason: str) -> None:
        self._site.faults.tell(self._wish.local, fault, reason)
        if self._handles:
            self._seat.endpoint.refuse(self._handles[waiting.part], waiting.ticket, reason)
