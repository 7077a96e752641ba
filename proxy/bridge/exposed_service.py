"""Local server exposed to remote clients: their requests are called here, and each gets its response.

I/O: endpoint and participant; ``gdp/service/serving.py`` keeps order. A service and an action differ in their parts.

It combines these modules:
- ``remote_clients.py``: decodes requests, holds those that wait for a description, and detects clients that left.
- ``response_sender.py``: sends responses to clients.
- ``cancellation.py``: stops calls.
- ``ordered_server.py``: drives a server that keeps state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gdp.client.participant import Message, Topic
from gdp.errors import LocalError, RemoteError
from gdp.intervals import DAY_S, LINGER_S
from gdp.limits import CALL_GRACE_S
from gdp.names import Name
from gdp.service.follower import Refuse
from gdp.service.frames import Answer, Request, Stop
from gdp.service.replication_messages import FollowerMessage
from gdp.service.server_window import ServerWindow
from gdp.service.serving import Asked, Serving
from proxy.bridge.cancellation import TRIGGER, Cancellation, GoalCalls
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.action_interface import CANCEL, GOAL, PROFILES, RESULT
from proxy.bridge.core.bridge_election import presence_of, sign
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.goals import cancel_of, goal_of
from proxy.bridge.core.joint_requests import JointRequests
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.ordered_server import OrderedServer
from proxy.bridge.remote_clients import ClientLiveness, RemoteClients, UndescribedRequests
from proxy.bridge.response_sender import ResponseSender
from proxy.bridge.service_flow import ServiceFlow
from proxy.config.rule import CALL_S
from proxy.endpoints.core.endpoint import (
    CallFailed,
    EndpointError,
    Event,
    GraphEntity,
    MessageReceived,
    ResponseReceived,
    TypeResolved,
)
from proxy.serial.schema import DefinitionError
from proxy.wire.replication import is_word, sequencer_message, to_wire

# requests that a ROS 2 server has at one time: its queue holds ten by default (rmw_qos_profile_services_default), and
# clients on its own machine use it, too
_QUEUE: Final = 8
_GONE: Final = "the server is gone"


class ExposedService(ServiceFlow):
    """Lets remote clients call one local server.

    Attributes:
        requests: how many were accepted from remote clients.
        request_bytes: their bytes on the overlay, before sealing.

    Raises:
        LocalError: this machine does not know a type.
    """

    far_role = "client"

    def __init__(
        self,
        context: BridgeContext,
        dispatcher: EndpointDispatcher,
        flow_spec: FlowSpec,
        topic: Topic,
        random_start: int,
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        self._serving = _serving_of(flow_spec, dispatcher.endpoint.ros, random_start)
        signers = flow_spec.rule.signers
        self._joint = None if signers is None else JointRequests(signers, self._serving)
        self._goals = GoalCalls()
        self._cancels = 0  # number of the last cancel request of the proxy itself
        self._refuses_from_s: float | None = None
        self._is_finished = False
        self._liveness = ClientLiveness()
        self._early = UndescribedRequests()
        endpoint, rule = dispatcher.endpoint, flow_spec.rule
        self._exchange = replace(self.parts.known(endpoint, rule.encoding), is_ordered=rule.is_ordered)
        self._remote_clients = RemoteClients(self._exchange, endpoint.ros, is_strict=flow_spec.rule.is_strict)
        self._mark = dispatcher.advertise(self, sign(presence_of(flow_spec.local), endpoint.ros))
        self._servers = [dispatcher.create_client(self, *part) for part in self.parts.services]
        self._stopper = None if rule.stop is None else dispatcher.create_client(self, rule.stop, TRIGGER)
        self._kept = None if not rule.is_ordered else self._keep(random_start)
        topics = zip(self.parts.topics, PROFILES, strict=False)
        self._topics = [dispatcher.subscribe(self, *part, profile) for part, profile in topics]
        self._publisher = context.member.serve(topic, self._exchange.to_cbor(), **self.options())
        self._responses = ResponseSender(self, self._exchange, self._serving, self._publisher)
        self._cancellation = Cancellation(
            endpoint=endpoint,
            serving=self._serving,
            goals=self._goals,
            servers=self._servers,
            stopper=self._stopper,
            is_concurrent=not self._serving.has_slots,
            cancel_goal=self._cancel_goal,
        )

    def receive(self, message: Message, now_s: float) -> None:
        """Process a remote client's request or its cancellations; both wait until the client's description arrives."""
        client = message.delivered.publisher
        self.context.contain(self.flow_spec.local, client, now_s, self._receive, message, now_s)

    def _receive(self, message: Message, now_s: float) -> None:
        if self._is_finished:
            self._refuse(message)
            return
        if not message.description:
            if not self._early.add(message):
                self._drop_early("too many requests came before their client's description")
            return
        client = Name(message.delivered.publisher)
        if self._kept is not None and is_word(message.delivered.message):
            self._kept.handle_message(client, sequencer_message(message.delivered.message), now_s)
        elif Stop.is_in(message.delivered.message):
            self._cancellation.handle_stop(client, Stop.from_wire(message.delivered.message), now_s)
        else:
            self._ask(message, now_s)
        self._give(now_s)

    def handle_event(self, event: Event, now_s: float) -> None:
        """Process an event of the local server or of an action's topics."""
        if (
            self._kept is not None
            and isinstance(event, ResponseReceived | CallFailed)
            and event.handle != self._stopper
        ):
            self._take_in_order(self._kept, event, now_s)
        elif isinstance(event, ResponseReceived | CallFailed) and event.handle == self._stopper:
            if isinstance(event, CallFailed):
                self.context.faults.report(f"{self.flow_spec.rule.stop}", Fault.REFUSED, event.reason)
        elif isinstance(event, ResponseReceived | CallFailed):
            self._end_call(event.call, event.reason if isinstance(event, CallFailed) else event.raw)
            self._give(now_s)
        elif isinstance(event, MessageReceived):
            at = self._topics.index(event.handle)
            self._responses.publish_news(at, event.raw, event.stamp_ns)
        elif isinstance(event, EndpointError):
            self.context.report_error(self.flow_spec.local, event, Fault.REFUSED)
        else:
            assert isinstance(event, TypeResolved)  # the types of an action's topics are known beforehand

    def tick(self, now_s: float) -> None:
        """Process requests that waited for their description, and check which clients are still present."""
        self._look_at_clients(now_s)
        if self._kept is not None:
            self._kept.update_sequencer(self.context.member.services.peers(self.name), now_s)
        self.handle_timer(now_s)

    def follow(self, ends: Sequence[GraphEntity], now_s: float) -> None:
        """Update the local servers of the name: for a service with state their identity matters."""
        if self._kept is not None:
            self._kept.follow(ends, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Drop calls whose time has run out."""
        for number, part, asked, is_given in self._serving.expired(now_s):
            if is_given:
                self._cancellation.handle_timeout(part, number)
            if asked is not None:
                self._goals.end(asked)
                self._responses.fail(asked, Fault.TIMED_OUT, "the server did not answer in time")
        self._give(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._serving.get_timer()

    def drain(self, now_s: float) -> None:
        """Redirect clients to other servers, and answer calls under way."""
        if self._refuses_from_s is None:
            self._refuses_from_s = now_s + LINGER_S  # of clients that have not received its notice yet
            self._publisher.describe(replace(self._exchange, is_leaving=True).to_cbor())

    def is_drained(self, now_s: float) -> bool:
        """Return whether none will be accepted, none is under way, and the clients have confirmed their responses."""
        is_closed = self._refuses_from_s is not None and now_s >= self._refuses_from_s
        if is_closed and self._kept is not None:
            self._kept.close()
        is_idle = not self._serving and (self._kept is None or self._kept.is_idle)
        return is_closed and is_idle and self.context.member.publications.is_acknowledged(self.name)

    def finish(self, now_s: float) -> None:
        """Fail the calls under way, and refuse requests from now on."""
        if self._is_finished:
            return
        self._is_finished = True
        for asked in self._serving.fail_all():
            self._goals.end(asked)
            self._responses.fail(asked, Fault.NO_SERVER, _GONE)
        for _ in range(self._early.forget_all_but(())):
            self._drop_early("the server is gone before their client's description came")
        stopper = [] if self._stopper is None else [self._stopper]
        kept = [] if self._kept is None else self._kept.handles
        for handle in [self._mark, *self._servers, *stopper, *kept, *self._topics]:
            self.dispatcher.close(handle)
        self._publisher.describe(replace(self._exchange, is_leaving=True).to_cbor())
        self.context.member.flush(now_s)

    def close(self, now_s: float) -> None:
        """Close the server; calls under way fail, and unconfirmed responses are lost."""
        self.finish(now_s)
        self.context.member.withdraw(self.name)

    def _look_at_clients(self, now_s: float) -> None:
        """Process requests that waited for their description; drop the calls of clients that left."""
        writer_proxies = self.context.member.subscriptions.writer_proxies_of(self.name)
        known = {bytes(writer_proxy.publisher): writer_proxy.description for writer_proxy in writer_proxies}
        for _ in range(self._early.forget_all_but(known.keys())):
            self._drop_early("a client left before its description came")
        for client, description in known.items():
            for message in self._early.poll_messages(client):
                self.receive(message._replace(description=description), now_s)
        here = {self.context.member.name, *self.context.member.services.connected_peers(self.name)}
        for client in self._liveness.update(self._serving.clients, present=here, known=known.keys(), now_s=now_s):
            self._cancellation.handle_client_gone(client)

    def _refuse(self, message: Message) -> None:
        """Refuse what came after the server had gone."""
        asked_for = message.delivered.message
        if not is_word(asked_for) and not Stop.is_in(asked_for):
            request = Request.from_wire(asked_for)
            self._responses.refuse(Asked(Name(message.delivered.publisher), request.part, request.call), _GONE)

    def _drop_early(self, reason: str) -> None:
        self.report(Fault.TOO_FAST, reason)

    def _ask(self, message: Message, now_s: float) -> None:
        delivered = message.delivered
        request = Request.from_wire(delivered.message)
        asked = Asked(Name(delivered.publisher), request.part, request.call)
        self.context.traffic.received(len(delivered.message))
        before = None if self._kept is not None else self._serving.answer_of(asked)
        if before is not None or asked in self._serving:
            if before:
                self._responses.send_wire(asked.client, before)
            return
        self.context.tracer.serving(self.call_key(*asked), self.flow_spec.local)
        if self._kept is None and self._refuses_from_s is not None and now_s >= self._refuses_from_s:
            self._responses.refuse(asked, "the server is leaving")
            return
        self.requests += 1
        self.request_bytes += len(delivered.message)
        try:
            raw = self._remote_clients.incoming(delivered.publisher, message.description, asked.part).decode(
                request.body
            )
            if self._kept is not None:
                self._kept.entry(asked.client, asked.call, raw, now_s)
                self._note_event("", asked.client.short)
            else:
                self._begin(now_s, self._patience_s(request), asked, raw)
        except DefinitionError as error:
            self._responses.fail(asked, Fault.OTHER_TYPE, str(error))
        except LocalError as error:
            self._responses.fail(asked, Fault.TOO_FAST, str(error))
        except RemoteError as error:
            self._responses.fail(asked, Fault.MALFORMED, str(error))

    def _patience_s(self, request: Request) -> float | None:
        """Return the seconds that a call may take; None: as long as its goal."""
        if self.flow_spec.rule.kind == "action" and request.part == RESULT and not request.patience_ms:
            return None
        asked_s = request.patience_ms / 1e3 + CALL_GRACE_S if request.patience_ms else DAY_S
        return min(asked_s, DAY_S)  # the most that a rule may state

    def _keep(self, number: int) -> OrderedServer:
        return OrderedServer(
            self,
            number,
            give=lambda number, raw: self.dispatcher.endpoint.call(self._servers[0], number, raw),
            tell=self._tell,
        )

    def _tell(self, client: Name, word: FollowerMessage | Refuse) -> None:
        if isinstance(word, Refuse):
            self.report(Fault.REFUSED, word.reason)
            self._responses.send_wire(client, Answer.failed(0, word.call, word.reason).to_wire())
        else:
            self._responses.send_wire(client, to_wire(word))

    def _take_in_order(self, kept: OrderedServer, event: ResponseReceived | CallFailed, now_s: float) -> None:
        entry = kept.done(event, now_s)
        if entry is not None and isinstance(event, ResponseReceived):
            self._responses.respond(Asked(entry.client, 0, entry.call), event.raw)
        elif entry is not None and isinstance(event, CallFailed):
            self._responses.fail(Asked(entry.client, 0, entry.call), Fault.REFUSED, event.reason)

    def _begin(self, now_s: float, patience_s: float | None, asked: Asked, raw: bytes) -> None:
        """Accept a request; one about a goal waits until the local server has accepted or rejected that goal."""
        if self._joint is not None:
            self._joint.add(now_s, patience_s, asked, raw)
            return
        goal = goal_of(raw) if self.flow_spec.rule.kind == "action" else b""
        after = None if asked.part == GOAL else self._goals.accepting(goal)
        self._serving.begin(now_s, patience_s, asked, raw, after)
        if goal and asked.part != CANCEL:
            self._goals.add(asked, goal)

    def _give(self, now_s: float) -> None:
        """Pass the next requests in order to the local server."""
        call, what = self.dispatcher.endpoint.call, self.flow_spec.local
        for turn in self._serving.poll_turns(now_s):
            given = self._servers[turn.asked.part], turn.number, turn.request
            if self.flow_spec.rule.kind == "service":
                self._note_event("", turn.asked.client.short)
            elif turn.asked.part == GOAL:
                self._note_event("/goal", goal_of(turn.request).hex())
            if not self.context.contain(what, turn.asked.client, now_s, call, *given):
                self._end_call(turn.number, "the request could not be passed on")

    def _note_event(self, part: str, which: str) -> None:
        """Begin windows around a call, or the end of a goal, in the topics whose rules state it."""
        if self.context.keeper is not None:
            self.context.keeper.handle_event(self.flow_spec.local + part, self.context.faults, which)

    def _end_call(self, number: int, ending: str | bytes) -> None:
        """Send the response of a call that has ended, or the reason why there is none."""
        ended = [self._serving.end(number), *(() if self._joint is None else self._joint.end_partners(number))]
        for asked in ended:
            if asked is None:
                continue
            goal = self._goals.end(asked)
            if isinstance(ending, bytes):
                if asked.part == RESULT and goal is not None:
                    self._note_event("/result", goal.hex())
                self._responses.respond(asked, ending)
            else:
                self._responses.fail(asked, Fault.REFUSED, ending)

    def _cancel_goal(self, goal: bytes, now_s: float) -> None:
        self._cancels += 1
        cancel = Asked(self.context.member.name, CANCEL, self._cancels)
        try:
            self._begin(now_s, CALL_S, cancel, cancel_of(goal))
        except LocalError as error:
            self.report(Fault.TOO_FAST, str(error))


def _serving_of(flow_spec: FlowSpec, ros: int, random_start: int) -> Serving[bytes]:
    """Return the requests of a server; without a rule it gets no more at one time than a short queue holds."""
    at_once = flow_spec.rule.at_once
    has_window = at_once is None and flow_spec.has_short_queues(ros)
    return Serving(random_start, at_once, window=ServerWindow(_QUEUE) if has_window else None)
