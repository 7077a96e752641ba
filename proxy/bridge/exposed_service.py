"""A local server on its way out: requests from far clients, asked here, answered to the one that asked.

Place: shell; endpoint and member do the I/O, ``gdp/service/serving.py`` keeps order. A service and an action differ in
their parts; and what nobody waits for any more is broken off by cancelling its goal, or by calling the rule's ``stop``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gdp.client.member import Message, Topic
from gdp.errors import LocalError, RemoteError
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.service.follower import Refuse
from gdp.service.ordered import FollowerWord
from gdp.service.serving import Asked, Serving
from proxy.bridge.callers import Callers
from proxy.bridge.early import Early
from proxy.bridge.goal_calls import GoalCalls
from proxy.bridge.goals import cancel_of, goal_of
from proxy.bridge.kept_server import KeptServer
from proxy.bridge.parts import CANCEL, GOAL, PROFILES, RESULT, Parts
from proxy.bridge.rivals import mark_of, sign
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Wish
from proxy.endpoints.endpoint import Answered, Described, End, Event, Failed, Faulted, Heard
from proxy.exchange import Answer, News, Outcome, Request, Stop, too_large
from proxy.faults import Fault
from proxy.ordering import is_word, keeper_word, to_wire
from proxy.rules.rule import CALL_MAX_S
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Serializer

__all__ = ["ExposedService"]

_GRACE_S: Final = 0.5  # it is the client's side that ends a call; here it is only forgotten
_CANCEL_S: Final = 5.0
_AWAY_S: Final = 30.0  # a client that is not heard for so long does not wait any more
_NOTICE_S: Final = 1.0  # a server that leaves still takes requests for so long: of clients that have not heard it yet
_TRIGGER: Final = "std_srvs/srv/Trigger"
_NO_FIELDS: Final = {1: b"", 2: b"\0\1\0\0\0"}  # a request of it; ROS 2 fills a message without fields with one byte


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
        self._serving: Serving[bytes] = Serving(random_start, wish.rule.at_once)
        self._goals = GoalCalls()
        self._words = 0  # of ours to the local server; their numbers
        self._refuses_from_s: float | None = None
        self._heard_s: dict[Name, float] = {}  # when clients were there last whose calls are under way
        self._early = Early()
        endpoint, rule = seat.endpoint, wish.rule
        parts = Parts.of(rule.kind, wish.local, wish.type_name)
        self._exchange = replace(parts.known(endpoint, rule.encoding), is_ordered=rule.is_ordered)
        self._callers = Callers(self._exchange, endpoint.ros)
        self._answers = [Serializer(each.response, rule.encoding) for each in self._exchange.services]
        self._news = [Serializer(each, rule.encoding) for each in self._exchange.topics]
        self._mark = seat.advertise(self, sign(mark_of(wish.local), endpoint.ros))
        self._servers = [seat.dial(self, *part) for part in parts.services]
        self._stopper = None if rule.stop is None else seat.dial(self, rule.stop, _TRIGGER)
        self._kept = None if not rule.is_ordered else self._keep(random_start)
        self._topics = [
            seat.subscribe(self, *part, profile) for part, profile in zip(parts.topics, PROFILES, strict=False)
        ]
        self._publisher = site.member.serve(
            topic, self._exchange.to_wire(), is_global=rule.is_global, urgent=rule.priority == "urgent"
        )

    def receive(self, message: Message, now_s: float) -> None:
        """Take a far client's request, or its word that some have ended; before its description both wait."""
        if not message.description:
            if not self._early.add(message):
                self._drop_early("too many requests came before their client's description")
            return
        try:
            if self._kept is not None and is_word(message.delivered.message):
                client = Name(message.delivered.publisher)
                self._kept.heard(client, keeper_word(message.delivered.message), now_s)
            elif Stop.is_in(message.delivered.message):
                self._stop(Name(message.delivered.publisher), Stop.from_wire(message.delivered.message), now_s)
            else:
                self._ask(message, now_s)
        except RemoteError as error:
            self._site.faults.tell(self._wish.local, Fault.MALFORMED, str(error))
        self._give()

    def take(self, event: Event, now_s: float) -> None:
        """Take what the local server, or an action's topics, say."""
        if self._kept is not None and isinstance(event, Answered | Failed) and event.handle != self._stopper:
            self._take_in_order(self._kept, event, now_s)
        elif isinstance(event, Answered | Failed) and event.handle == self._stopper:
            if isinstance(event, Failed):
                self._site.faults.tell(f"{self._wish.rule.stop}", Fault.REFUSED, event.reason)
        elif isinstance(event, Answered | Failed):
            asked = self._serving.end(event.call)
            if asked is not None:
                self._goals.end(asked)
            if asked is not None and isinstance(event, Answered):
                self._answer(asked, event.raw)
            elif asked is not None and isinstance(event, Failed):
                self._fail(asked, Fault.REFUSED, event.reason)
            self._give()
        elif isinstance(event, Heard):
            self._publish(event)
        elif isinstance(event, Faulted):
            self._site.tell(self._wish.local, event, Fault.REFUSED)
        else:
            assert isinstance(event, Described)  # what an action's topics are was known before

    def tick(self, now_s: float) -> None:
        """Take what came before its description; look whose clients are still there."""
        self._look_at_clients(now_s)
        if self._kept is not None:
            self._kept.look(self._site.member.peers(self._topic.name), now_s)
        self.timeout(now_s)

    def follow(self, ends: Sequence[End], now_s: float) -> None:
        """Take the local servers of the name: where state is kept it matters which one it is."""
        if self._kept is not None:
            self._kept.follow(ends, now_s)

    def timeout(self, now_s: float) -> None:
        """Give up what its client no longer waits for."""
        for number, part, asked, is_given in self._serving.expired(now_s):
            if is_given:
                self._seat.endpoint.drop(self._servers[part], number)
                self._break_off()
            if asked is not None:
                self._goals.end(asked)
                self._fail(asked, Fault.TIMED_OUT, "the server did not answer in time")
        self._give()

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._serving.next_timeout()

    def drain(self, now_s: float) -> None:
        """Tell clients to ask others, and answer what is under way."""
        if self._refuses_from_s is None:
            self._refuses_from_s = now_s + _NOTICE_S
            self._publisher.describe(replace(self._exchange, is_leaving=True).to_wire())

    def is_drained(self, now_s: float) -> bool:
        """Return whether nothing is under way any more, and nothing new will be."""
        is_closed = self._refuses_from_s is not None and now_s >= self._refuses_from_s
        if is_closed and self._kept is not None:
            self._kept.close()
        return is_closed and not self._serving and (self._kept is None or self._kept.is_idle)

    def close(self, now_s: float) -> None:
        """Serve nobody any more; calls under way fail."""
        for asked in self._serving.fail_all():
            self._goals.end(asked)
            self._fail(asked, Fault.NO_SERVER, "the server is gone")
        for _ in range(self._early.forget_all_but(())):
            self._drop_early("the server is gone before their client's description came")
        stopper = [] if self._stopper is None else [self._stopper]
        kept = [] if self._kept is None else self._kept.handles
        for handle in [self._mark, *self._servers, *stopper, *kept, *self._topics]:
            self._seat.close(handle)
        self._site.member.flush(now_s)  # what was said last must not wait: it would go with its stream
        self._site.member.withdraw(self._topic.name)

    def renew(self, topic: Topic) -> None:
        """Take the delegation anew."""
        self._topic = topic
        self._site.member.renew(topic)

    def _look_at_clients(self, now_s: float) -> None:
        """Take what came before its description; let the calls of clients that left go."""
        feeds = self._site.member.feeds_of(self._topic.name)
        known = {bytes(feed.publisher): feed.description for feed in feeds}
        for _ in range(self._early.forget_all_but(known.keys())):
            self._drop_early("a client left before its description came")
        for client, description in known.items():
            for message in self._early.take(client):
                self.receive(message._replace(description=description), now_s)
        here = {self._site.member.name, *self._site.member.heard(self._topic.name)}
        clients = self._serving.clients
        self._heard_s = {each: now_s if each in here else self._heard_s.get(each, now_s) for each in clients}
        for client, heard_s in self._heard_s.items():
            if client not in here and (bytes(client) not in known or now_s - heard_s >= _AWAY_S):
                self._let_go(client)

    def _drop_early(self, reason: str) -> None:
        self._site.faults.tell(self._wish.local, Fault.TOO_FAST, reason)

    def _let_go(self, client: Name) -> None:
        """Forget the calls of a client that left. Its goals go on: it may come back, and ask for their results."""
        is_working = False
        for number, part, asked, is_given in self._serving.gone(client):
            if asked is not None:
                self._goals.end(asked)
            if is_given:
                is_working = True
                self._give_up(part, number)
        if is_working:
            self._break_off()

    def _give_up(self, part: int, number: int) -> None:
        """Await no more what the local server works on, unless the next one waits for that."""
        if self._wish.rule.at_once is None:
            self._seat.endpoint.drop(self._servers[part], number)

    def _ask(self, message: Message, now_s: float) -> None:
        delivered = message.delivered
        request = Request.from_wire(delivered.message)
        asked = Asked(Name(delivered.publisher), request.part, request.call)
        self._site.traffic.received(len(delivered.message))
        before = None if self._kept is not None else self._serving.answer_of(asked)
        if before is not None or asked in self._serving:
            if before:
                self._send_wire(asked.client, before)
            return
        if self._kept is None and self._refuses_from_s is not None and now_s >= self._refuses_from_s:
            self._send(asked, Answer.failed(asked.part, asked.call, "the server is leaving"))
            return
        try:
            raw = self._callers.incoming(delivered.publisher, message.description, asked.part).decode(request.body)
            if self._kept is not None:
                self._kept.entry(asked.client, asked.call, raw, now_s)
            else:
                self._begin(now_s, self._patience_s(request), asked, raw)
        except DefinitionError as error:
            self._fail(asked, Fault.OTHER_TYPE, str(error))
        except LocalError as error:
            self._fail(asked, Fault.TOO_FAST, str(error))
        except RemoteError as error:
            self._fail(asked, Fault.MALFORMED, str(error))

    def _patience_s(self, request: Request) -> float | None:
        """Return how long a call may take; None: as long as a goal does."""
        if self._wish.rule.kind == "action" and request.part == RESULT and not request.patience_ms:
            return None
        asked_s = request.patience_ms / 1e3 + _GRACE_S if request.patience_ms else CALL_MAX_S
        return min(asked_s, CALL_MAX_S)

    def _keep(self, number: int) -> KeptServer:
        rule, what = self._wish.rule, self._wish.local
        return KeptServer(
            self._seat, self, rule.state_node, number,
            give=lambda number, raw: self._seat.endpoint.call(self._servers[0], number, raw),
            tell=self._tell,
            complain=lambda reason: self._site.faults.tell(what, Fault.REFUSED, reason),
        )  # fmt: skip

    def _tell(self, client: Name, word: FollowerWord | Refuse) -> None:
        if isinstance(word, Refuse):
            self._site.faults.tell(self._wish.local, Fault.REFUSED, word.reason)
            self._send_wire(client, Answer.failed(0, word.call, word.reason).to_wire())
        else:
            self._send_wire(client, to_wire(word))

    def _take_in_order(self, kept: KeptServer, event: Answered | Failed, now_s: float) -> None:
        entry = kept.done(event, now_s)
        if entry is not None and isinstance(event, Answered):
            self._answer(Asked(entry.client, 0, entry.call), event.raw)
        elif entry is not None and isinstance(event, Failed):
            self._fail(Asked(entry.client, 0, entry.call), Fault.REFUSED, event.reason)

    def _begin(self, now_s: float, patience_s: float | None, asked: Asked, raw: bytes) -> None:
        """Take a request; what is about a goal waits until the local server knows whether it accepts that one."""
        goal = goal_of(raw) if self._wish.rule.kind == "action" else b""
        after = None if asked.part == GOAL else self._goals.accepting(goal)
        self._serving.begin(now_s, patience_s, asked, raw, after)
        if goal and asked.part != CANCEL:
            self._goals.begin(asked, goal)

    def _give(self) -> None:
        """Give the local server what it is the turn of."""
        for number, asked, raw in self._serving.take():
            self._seat.endpoint.call(self._servers[asked.part], number, raw)

    def _stop(self, client: Name, stop: Stop, now_s: float) -> None:
        """Learn that a client's calls have ended: what waits is left undone, what is worked on is broken off."""
        is_working = False
        for call in stop.calls:
            asked = Asked(client, stop.part, call)
            goal = self._goals.end(asked)
            number = self._serving.stop(asked)
            if number is not None and stop.part < len(self._servers):
                is_working = True
                self._give_up(stop.part, number)
            if goal is not None and stop.part == RESULT and not self._goals.is_awaited(goal):
                self._cancel(goal, now_s)
        if is_working:
            self._break_off()

    def _cancel(self, goal: bytes, now_s: float) -> None:
        self._words += 1
        cancel = Asked(self._site.member.name, CANCEL, self._words)
        try:
            self._begin(now_s, _CANCEL_S, cancel, cancel_of(goal))
        except LocalError as error:
            self._site.faults.tell(self._wish.local, Fault.TOO_FAST, str(error))

    def _break_off(self) -> None:
        """Let the local server know that nobody waits for what it works on, if the rule says how."""
        if self._stopper is not None:
            self._seat.endpoint.drop(self._stopper, self._words)  # what the last word came to is nobody's
            self._words += 1
            self._seat.endpoint.call(self._stopper, self._words, _NO_FIELDS[self._seat.endpoint.ros])

    def _answer(self, asked: Asked, raw: bytes) -> None:
        body = self._answers[asked.part].encode(raw)
        if reason := too_large("an answer", len(raw), self._wish.rule.max_bytes, len(body)):
            self._fail(asked, Fault.TOO_LARGE, reason)
        else:
            self._send(asked, Answer(asked.part, asked.call, Outcome.ANSWERED, body))

    def _fail(self, asked: Asked, fault: Fault, reason: str) -> None:
        self._site.faults.tell(self._wish.local, fault, reason)
        self._send(asked, Answer.failed(asked.part, asked.call, reason))

    def _send(self, asked: Asked, answer: Answer) -> None:
        if asked.client == self._site.member.name:
            return  # our own word that a goal is cancelled
        wire = answer.to_wire()
        self._serving.remember(asked, wire)
        self._send_wire(asked.client, wire)

    def _send_wire(self, client: Name, wire: bytes) -> None:
        try:
            self._site.member.answer(self._topic.name, client, wire)
        except LocalError:
            self._site.traffic.unread += 1  # the client is gone
            return
        self._site.traffic.sent(len(wire))

    def _publish(self, event: Heard) -> None:
        """Tell all clients what an action's topic says."""
        at, what = self._topics.index(event.handle), self._wish.local
        if not self._publisher.is_wanted:
            self._site.traffic.unread += 1
            self._publisher.skip(LossReason.NO_READER)
            return
        if not self._publisher.has_room():
            self._site.faults.tell(what, Fault.TOO_FAST, "news come faster than clients confirm them")
            self._publisher.skip(LossReason.WINDOW_OVERFLOW)
            return
        body = self._news[at].encode(event.raw)
        if reason := too_large("news", len(event.raw), self._wish.rule.max_bytes, len(body)):
            self._site.faults.tell(what, Fault.TOO_LARGE, reason)
            self._publisher.skip(LossReason.TOO_LARGE)
            return
        wire = News(len(self._exchange.services) + at, event.stamp_ns, body).to_wire()
        self._publisher.publish(wire)
        self._site.traffic.sent(len(wire))
