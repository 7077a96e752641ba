"""A local server on its way out: requests from far clients, asked here, answered to the one that asked.

Place: shell; endpoint and member do the I/O. A service and an action differ only in their parts.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from gdp.client.member import Message, Topic
from gdp.errors import LocalError, RemoteError
from gdp.names import Name
from gdp.service.calls import Calls
from proxy.bridge.incoming import Incoming
from proxy.bridge.parts import PROFILES, Parts
from proxy.bridge.rivals import mark_of, sign
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Wish
from proxy.endpoints.endpoint import Answered, Described, Event, Failed, Faulted, Heard
from proxy.exchange import Answer, Exchange, News, Outcome, Request, too_large
from proxy.faults import Fault
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Serializer

__all__ = ["ExposedService"]

_CALLS_MAX = 65_536  # under way at one server
_EARLY_MAX = 256  # requests of clients that are not described yet
_GRACE_S = 0.5  # it is the client's side that ends a call; here it is only forgotten
_CLIENTS_MAX = 1_024  # descriptions of clients kept ready; the oldest go


class _Asked(NamedTuple):
    """A call under way here: whose, under which number of theirs."""

    client: Name
    part: int
    call: int


class ExposedService:
    """Lets far clients call one local server.

    Args:
        random_start: the first number of a call here, random.

    Raises:
        LocalError: this machine does not know a type.
    """

    def __init__(self, site: Site, seat: Seat, wish: Wish, topic: Topic, random_start: int) -> None:
        self._site = site
        self._seat = seat
        self._wish = wish
        self._topic = topic
        self._calls: Calls[_Asked] = Calls(_CALLS_MAX, random_start)
        self._clients: dict[tuple[bytes, bytes], tuple[Incoming, ...]] = {}
        self._early = deque[Message](maxlen=_EARLY_MAX)
        endpoint, rule = seat.endpoint, wish.rule
        parts = Parts.of(rule.kind, wish.local, wish.type_name)
        self._exchange = parts.known(endpoint, rule.encoding)
        self._answers = [Serializer(each.response, rule.encoding) for each in self._exchange.services]
        self._news = [Serializer(each, rule.encoding) for each in self._exchange.topics]
        self._mark = seat.advertise(self, sign(mark_of(wish.local), endpoint.ros))
        self._servers = [seat.dial(self, *part) for part in parts.services]
        self._topics = [
            seat.subscribe(self, *part, profile) for part, profile in zip(parts.topics, PROFILES, strict=False)
        ]
        self._publisher = site.member.serve(
            topic, self._exchange.to_wire(), is_global=rule.is_global, urgent=rule.priority == "urgent"
        )

    def receive(self, message: Message, now_s: float) -> None:
        """Take a far client's request; what comes before its description waits for that."""
        if not message.description:
            self._early.append(message)
            return
        try:
            self._ask(message, now_s)
        except RemoteError as error:
            self._site.faults.tell(self._wish.local, Fault.MALFORMED, str(error))

    def take(self, event: Event, now_s: float) -> None:
        """Take what the local server, or an action's topics, say."""
        del now_s
        if isinstance(event, Answered):
            asked = self._calls.answered(event.call)
            if asked is not None:
                self._answer(asked, event.raw)
        elif isinstance(event, Failed):
            asked = self._calls.answered(event.call)
            if asked is not None:
                self._fail(asked, Fault.REFUSED, event.reason)
        elif isinstance(event, Heard):
            self._publish(event)
        elif isinstance(event, Faulted):
            self._site.tell(self._wish.local, event, Fault.REFUSED)
        else:
            assert isinstance(event, Described)  # what an action's topics are was known before

    def tick(self, now_s: float) -> None:
        """Give up what its client no longer waits for."""
        if self._early:
            self._take_early(now_s)
        for number, asked in self._calls.expired(now_s):
            self._seat.endpoint.drop(self._servers[asked.part], number)
            self._fail(asked, Fault.TIMED_OUT, "the server did not answer in time")

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._calls.next_timeout()

    def close(self, now_s: float) -> None:
        """Serve nobody any more; calls under way fail."""
        for _, asked in self._calls.fail_all():
            self._fail(asked, Fault.NO_SERVER, "the server is gone")
        for handle in [self._mark, *self._servers, *self._topics]:
            self._seat.close(handle)
        self._site.member.flush(now_s)  # what was said last must not wait: it would go with its stream
        self._site.member.withdraw(self._topic.name)

    def renew(self, topic: Topic) -> None:
        """Take the delegation anew."""
        self._topic = topic
        self._site.member.renew(topic)

    def _take_early(self, now_s: float) -> None:
        feeds = self._site.member.feeds_of(self._topic.name)
        known = {bytes(feed.publisher): feed.description for feed in feeds}
        for _ in range(len(self._early)):
            message = self._early.popleft()
            if message.delivered.publisher in known:  # else the client is gone
                self.receive(message._replace(description=known[message.delivered.publisher]), now_s)

    def _ask(self, message: Message, now_s: float) -> None:
        delivered = message.delivered
        request = Request.from_wire(delivered.message)
        asked = _Asked(Name(delivered.publisher), request.part, request.call)
        self._site.traffic.received(len(delivered.message))
        try:
            incoming = self._incoming(message)
            if request.part >= len(incoming):
                raise DefinitionError("the client asks for a part that this service has not")
            raw = incoming[request.part].decode(request.body)
            patience_s = request.patience_ms / 1e3 + _GRACE_S if request.patience_ms else None
            number = self._calls.begin(now_s, patience_s, asked)
        except LocalError as error:
            self._fail(asked, Fault.OTHER_TYPE, str(error))
            return
        except RemoteError as error:
            self._fail(asked, Fault.MALFORMED, str(error))
            return
        self._seat.endpoint.call(self._servers[request.part], number, raw)

    def _incoming(self, message: Message) -> tuple[Incoming, ...]:
        """Return what a client's requests are, by part.

        Raises:
            DefinitionError: they are not what our server takes.
        """
        key = (message.delivered.publisher, message.description)
        if key not in self._clients:
            theirs, ros = Exchange.from_wire(message.description), self._seat.endpoint.ros
            pairs = zip(theirs.services, self._exchange.services, strict=False)
            self._clients[key] = tuple(
                Incoming.ready(their.request, theirs.encoding, our.request, ros) for their, our in pairs
            )
            while len(self._clients) > _CLIENTS_MAX:
                del self._clients[next(iter(self._clients))]
        return self._clients[key]

    def _answer(self, asked: _Asked, raw: bytes) -> None:
        body = self._answers[asked.part].encode(raw)
        if reason := too_large("an answer", len(raw), self._wish.rule.max_bytes, len(body)):
            self._fail(asked, Fault.TOO_LARGE, reason)
        else:
            self._send(asked, Answer(asked.part, asked.call, Outcome.ANSWERED, body))

    def _fail(self, asked: _Asked, fault: Fault, reason: str) -> None:
        self._site.faults.tell(self._wish.local, fault, reason)
        self._send(asked, Answer.failed(asked.part, asked.call, reason))

    def _send(self, asked: _Asked, answer: Answer) -> None:
        wire = answer.to_wire()
        try:
            self._site.member.answer(self._topic.name, asked.client, wire)
        except LocalError:
            self._site.traffic.unread += 1  # the client is gone
            return
        self._site.traffic.sent(len(wire))

    def _publish(self, event: Heard) -> None:
        """Tell all clients what an action's topic says."""
        at, what = self._topics.index(event.handle), self._wish.local
        if not self._publisher.readers:
            self._site.traffic.unread += 1
            return
        if not self._publisher.has_room():
            self._site.faults.tell(what, Fault.TOO_FAST, "news come faster than clients confirm them")
            return
        body = self._news[at].encode(event.raw)
        if reason := too_large("news", len(event.raw), self._wish.rule.max_bytes, len(body)):
            self._site.faults.tell(what, Fault.TOO_LARGE, reason)
            return
        wire = News(len(self._exchange.services) + at, event.stamp_ns, body).to_wire()
        self._publisher.publish(wire)
        self._site.traffic.sent(len(wire))
