"""Virtual server on this machine for the remote servers of one service or action.

I/O: endpoint and participant; ``gdp/service/dispatch.py`` or ``gdp/service/sequencer.py`` decide. The virtual server
exists while a remote one is reachable, so that local clients see whether there is one. That of a far node of a pattern
exists while the node does: it joins the service when it has a request, which then waits for a server. A call ends with
the first response, with a reason, or when its time is up. A later response is counted, and servers that still work on
the call get a cancellation.

It combines ``server_discovery.py`` (the servers), ``request_sender.py`` (the requests to each of them) and
``virtual_server.py`` (what local clients see).
"""

from __future__ import annotations

import secrets
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Final

from gdp.client.participant import Message, Topic
from gdp.due_queue import earliest
from gdp.errors import LocalError, RemoteError
from gdp.intervals import FORGET_S, NEVER_S
from gdp.names import Name
from gdp.service.dispatch import Dispatch, Failure
from gdp.service.frames import PATIENCE_MAX_MS, Answer, Outcome, Request
from gdp.service.replication import ALL, Mode
from gdp.service.replication_messages import INCARNATION_BITS
from gdp.service.sequencer import Sequencer
from gdp.trust.advertisement import session_value
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.action_interface import CANCEL, GOAL, RESULT
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.goals import Goals, goal_of, says_yes
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.request_sender import RequestSender
from proxy.bridge.server_discovery import SERVER_GONE, Response, ServerCalls, ServerDiscovery
from proxy.bridge.service_flow import ServiceFlow
from proxy.bridge.virtual_server import VirtualServer
from proxy.config.brought_rule import BroughtRule
from proxy.config.rule import CALL_S
from proxy.endpoints.core.endpoint import EndpointError, Event, RequestReceived
from proxy.serial.empty import NoAnswer
from proxy.serial.serializer import Serializer
from proxy.wire.replication import follower_message, is_word
from proxy.wire.service import Exchange, News, too_large

_HELD_MAX: Final = 64  # requests that wait for a server
_FAULTS: Final = {
    Failure.TIMED_OUT: Fault.TIMED_OUT,
    Failure.NO_SERVER: Fault.NO_SERVER,
    Failure.REFUSED: Fault.REFUSED,
}


@dataclass(slots=True)
class _Waiting:
    """A local client's request, with its goal if it belongs to an action."""

    part: int
    handle: int
    ticket: int
    goal: bytes
    begun_s: float
    call: int = 0


class ImportedService(ServiceFlow):
    """Lets local clients call one remote service or action.

    Attributes:
        requests: how many local clients made.
        request_bytes: their bytes in ROS's wire form.
        failed: requests that ended without a response.
        is_joined: whether it is called on the overlay.
        answered_by: the server whose response ended the latest call; None: none did yet.
    """

    far_role = "server"

    def __init__(
        self,
        context: BridgeContext,
        dispatcher: EndpointDispatcher,
        flow_spec: FlowSpec,
        topic: Topic,
        random_start: int,
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        self._goals = Goals() if flow_spec.rule.kind == "action" else None
        self._sequencer: Sequencer[Response] | None = None
        self._outside: dict[Name, str] = {}  # servers that cannot be kept in order, with the reported reason
        if flow_spec.rule.is_ordered:
            self._sequencer = Sequencer(incarnation_id=lambda: secrets.randbits(INCARNATION_BITS))
        spreads = [
            ALL if self._goals is not None and part == CANCEL else flow_spec.rule.spread
            for part in range(len(self.parts.services))
        ]
        self._calls: tuple[ServerCalls, ...] = tuple(
            self._sequencer
            if self._sequencer is not None
            else Dispatch[Response](
                spread,
                start=random_start,
                stops=self._goals is None or part == RESULT,  # every server has the goal, until one has its result
                unicasts=session_value(flow_spec.rule.sign),
                paths=context.member.services.paths_for(topic.name, spread),
            )
            for part, spread in enumerate(spreads)
        )
        self._now_s = 0.0  # of the last event
        self.failed = 0
        self.answered_by: Name | None = None
        self.first_answers = Counter[Name]()  # by server, of the calls that a first response ended
        self._counted: tuple[int, ...] = (0, 0, 0)  # late, unexpected and hedged, as reported last
        self._requests: tuple[Serializer, ...] = ()
        self._no_answers: tuple[NoAnswer | None, ...] = ()  # None: the dialect has errors
        self._virtual_server = VirtualServer(self)
        self._sender = RequestSender(self, self._calls, self._goals)
        self._discovery = ServerDiscovery(self, self._calls, self._goals, opened=self._open, closed=self._shut)
        self.is_joined = False
        self._held: list[RequestReceived] = []  # until there is a server
        self._held_until_s = self._used_s = NEVER_S
        self._offered: Exchange | None = None
        rule, known = flow_spec.rule, self._known()
        self._is_lazy = isinstance(rule, BroughtRule) and rule.is_lazy and rule.kind == "service" and known is not None
        if self._is_lazy and known is not None:
            self._open(known)
        else:
            self._join()

    @property
    def servers(self) -> list[Name]:
        """Return the servers that can be asked now."""
        return list(self._calls[0].servers)

    def ranking(self, now_s: float) -> list[str]:
        """Return the servers in the order of their paths' costs, where requests go to the nearest: name and reason."""
        ranked = self._calls[0].ranking(now_s) if isinstance(self._calls[0], Dispatch) else []
        return [f"{name.short} (cost {cost}{', silent' if silent else ''})" for name, cost, silent in ranked]

    @property
    def late(self) -> int:
        """Return how many responses were not the first."""
        return sum(each.late for each in self._calls)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a remote server's response, or a message of its action's topics."""
        self.context.traffic.received(len(message.delivered.message))
        self._now_s = now_s
        server = message.delivered.publisher
        self.context.contain(self.flow_spec.local, server, now_s, self._receive, message, now_s)

    def handle_event(self, event: Event, now_s: float) -> None:
        """Process a local client's request."""
        if isinstance(event, RequestReceived):
            self._used_s = now_s
            if self._is_lazy and not self.servers and len(self._held) < _HELD_MAX:
                self._hold(event, now_s)
                return
            self._ask(event, now_s)
            self._flush(now_s)
        elif isinstance(event, EndpointError):
            self.context.report_error(self.flow_spec.local, event, Fault.REFUSED)

    def tick(self, now_s: float) -> None:
        """Open or close the virtual server as remote servers join and leave."""
        if not self.is_joined:
            return
        self._discovery.update(now_s)
        if self._held and (self.servers or now_s >= self._held_until_s):
            held, self._held = self._held, []
            for event in held:
                self._ask(event, now_s)
        self.handle_timer(now_s)
        self._count()
        if self._sequencer is not None:
            outside = dict(self._sequencer.outside)
            for name in [name for name, reason in outside.items() if self._outside.get(name) != reason]:
                self.report(Fault.REFUSED, f"server {name.short}: {outside[name]}")
            self._outside = outside
        if self._is_lazy and now_s - self._used_s > FORGET_S and not (self._held or any(map(len, self._calls))):
            self._leave(now_s)

    def handle_timer(self, now_s: float) -> None:
        """Run due timers between checks of the servers."""
        for dispatch in self._calls:
            dispatch.handle_timer(now_s)
        self._flush(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if not self.is_joined:
            return None
        if self._sender.is_ready:
            return 0.0
        of_calls = (dispatch.get_timer() for dispatch in self._calls)
        return earliest(self._virtual_server.get_timer(self._now_s), *of_calls)

    def close(self, now_s: float) -> None:
        """Close the virtual server; calls under way fail."""
        del now_s
        for event in self._held:
            self.report(Fault.NO_SERVER, SERVER_GONE)
            self._virtual_server.refuse(event.handle, event.ticket, SERVER_GONE)
        self._shut("the proxy no longer carries this service")
        self._virtual_server.close_now()
        self.context.member.withdraw(self.name)

    def _receive(self, message: Message, now_s: float) -> None:
        if message.private and self._sequencer is not None and is_word(message.delivered.message):
            word, name = follower_message(message.delivered.message), Name(message.delivered.publisher)
            self._discovery.find(name, now_s)
            self._sequencer.positioned(name, word, now_s)
        elif message.private:
            self._receive_response(message, now_s)
        else:
            self._receive_news(message)
        self._flush(now_s)

    def _flush(self, now_s: float) -> None:
        self._now_s = now_s
        self._sender.flush(now_s)
        self._virtual_server.flush(now_s)

    def _count(self) -> None:
        """Add the increments since the last call to the proxy's counters."""
        traffic = self.context.traffic
        now = tuple(
            sum(counts) for counts in zip(*((d.late, d.unexpected, d.hedged) for d in self._calls), strict=True)
        )
        traffic.late += now[0] - self._counted[0]
        traffic.unexpected += now[1] - self._counted[1]
        traffic.hedged += now[2] - self._counted[2]
        self._counted = now

    def _known(self) -> Exchange | None:
        """Return this machine's description of the service; None where only the remote side has one."""
        try:
            return self.parts.known(self.dispatcher.endpoint, self.flow_spec.rule.encoding)
        except LocalError:
            return None

    def _hold(self, event: RequestReceived, now_s: float) -> None:
        """Keep a request until there is a server, for as long as it may wait for a response."""
        if not self._held:
            self._held_until_s = now_s + (self.flow_spec.rule.timeout_s or CALL_S)
        self._held.append(event)
        if not self.is_joined:
            self._join()

    def _join(self) -> None:
        known, services = self._known(), self.context.member.services
        description = b"" if known is None else known.to_cbor()
        self._sender.publisher = self.context.member.call(self.topic, description, **self.options())
        services.paths_for(self.name, self.flow_spec.rule.spread)  # the switch states costs from now on
        self.is_joined = self.has_changed = True

    def _leave(self, now_s: float) -> None:
        """Leave a service that no local node has used for a while."""
        self.context.member.withdraw(self.name)
        self._sender.publisher, self.is_joined, self.has_changed = None, False, True
        self._discovery.update(now_s)

    def _open(self, ours: Exchange) -> None:
        if self._sender.publisher is not None:
            self._sender.publisher.describe(ours.to_cbor())
        if self._offered == ours:
            return
        if self._offered is not None:
            self._virtual_server.close_now()
        self._offered = ours
        self._requests = tuple(Serializer(each.request, ours.encoding) for each in ours.services)
        self._no_answers = tuple(NoAnswer.of(each) for each in ours.services)
        self._virtual_server.open(ours)

    def _shut(self, reason: str) -> None:
        for dispatch in self._calls:
            dispatch.fail_all(reason)
        self._sender.clear()
        if self._goals is not None:
            self._goals.clear()
        if not self._is_lazy:
            self._offered = None
            self._virtual_server.close()

    def _ask(self, event: RequestReceived, now_s: float) -> None:
        part, rule = self._virtual_server.handle_request(event.handle, now_s), self.flow_spec.rule
        self.requests += 1
        self.request_bytes += len(event.raw)
        if part is None:
            self.report(Fault.NO_SERVER, SERVER_GONE)
            self._virtual_server.refuse(event.handle, event.ticket, SERVER_GONE)
            return
        waiting = _Waiting(part, event.handle, event.ticket, b"", now_s)
        body = self._requests[part].encode(event.raw)
        if reason := too_large("a request", len(event.raw), rule.max_bytes, len(body)):
            self._refuse(waiting, Fault.TOO_LARGE, reason)
            return
        first: tuple[Name, ...] = ()
        timeout_s = rule.timeout_s
        try:
            if self._goals is not None:
                waiting.goal = goal_of(event.raw)
                if part == RESULT:
                    first, timeout_s = self._holders(waiting.goal, self._goals), None
            write = partial(self._write, waiting, body, timeout_s)
            answered, failed = partial(self._answered, waiting), partial(self._failed, waiting)
            self._calls[part].begin(now_s, write, timeout_s, answered, failed, first)
        except RemoteError as error:
            self._refuse(waiting, Fault.MALFORMED, str(error))
        except LocalError as error:
            fault = Fault.REFUSED if self._sequencer is not None else Fault.TOO_FAST
            self._refuse(waiting, fault if self._calls[part].servers else Fault.NO_SERVER, str(error))

    def _write(self, waiting: _Waiting, body: bytes, timeout_s: float | None, call: int) -> bytes:
        patience_ms = 0 if timeout_s is None else min(max(int(timeout_s * 1e3), 1), PATIENCE_MAX_MS)
        wire = Request(waiting.part, call, patience_ms, body).to_wire()
        waiting.call = call
        self.context.tracer.begun(self.own_key(waiting.part, call), self.flow_spec.local)
        if self._goals is not None:
            self._sender.note_goal(waiting.part, call, waiting.goal)
            if waiting.part == GOAL:
                self._goals.sent(waiting.goal, wire)
            elif waiting.part == CANCEL:
                self._goals.cancelled(waiting.goal)
        return wire

    def _holders(self, goal: bytes, goals: Goals) -> tuple[Name, ...]:
        """Return the servers to ask for a result, in place of the rule's choice; empty: the rule's choice applies."""
        servers = self._calls[RESULT].servers
        holders = goals.holders(goal) & set(servers)
        if self.flow_spec.rule.spread.mode is Mode.ALL:
            return () if not holders or len(holders) == len(servers) else tuple(servers)
        return tuple(holders or servers)

    def _receive_response(self, message: Message, now_s: float) -> None:
        answer, name = Answer.from_wire(message.delivered.message), Name(message.delivered.publisher)
        server = self._discovery.find(name, now_s)
        if server is None or answer.part >= len(server.answers):
            return  # of a server that left, or that has no valid description here: that was reported
        dispatch, key = self._calls[answer.part], self.own_key(answer.part, answer.call)
        if answer.outcome is Outcome.FAILED:
            self.context.tracer.responded(key, name, answer.reason)
            dispatch.refused(answer.call, name, answer.reason, now_s)
            return
        try:
            raw = server.answers[answer.part].decode(answer.body)
        except RemoteError as error:
            self.report(Fault.MALFORMED, str(error))
            self.context.tracer.responded(key, name, str(error))
            dispatch.refused(answer.call, name, str(error), now_s)
            return
        self.context.tracer.responded(key, name)
        if self._goals is None or says_yes(answer.part, raw):
            dispatch.answered(answer.call, name, (name, raw), now_s)
        else:
            dispatch.declined(answer.call, name, (name, raw), now_s)

    def _answered(self, waiting: _Waiting, response: Response) -> None:
        server, raw = response
        self.answered_by = server
        self._forget(waiting)
        if waiting.part == 0:  # of an action the answer to its goal; results take as long as they want
            self.context.traffic.call_ended(self.name.to_text(), max(self._now_s - waiting.begun_s, 0.0))
        self.first_answers[server] += 1
        self.context.tracer.answered(self.own_key(waiting.part, waiting.call), server)
        self._virtual_server.answer(waiting.handle, waiting.ticket, raw)
        if self._goals is None or not says_yes(waiting.part, raw):
            return
        if waiting.part == GOAL:
            self._goals.accepted(waiting.goal, server)
        elif waiting.part == RESULT:
            self._tell_status(self._goals.ended(waiting.goal, server, raw))

    def _failed(self, waiting: _Waiting, failure: Failure, reason: str) -> None:
        self._forget(waiting)
        self.failed += 1
        self.context.tracer.failed(self.own_key(waiting.part, waiting.call), reason or failure.value)
        if failure is not Failure.TIMED_OUT:
            self._refuse(waiting, _FAULTS[failure], reason)
            return
        reason = f"no answer within {self.flow_spec.rule.timeout_s:g} s"
        no_answer = self._no_answers[waiting.part]
        if no_answer is None or no_answer.says_reason or self.flow_spec.rule.on_timeout == "silent":
            self._refuse(waiting, Fault.TIMED_OUT, reason)
            return
        self.report(Fault.TIMED_OUT, reason)
        self._virtual_server.answer(waiting.handle, waiting.ticket, no_answer.to_raw(reason))

    def _forget(self, waiting: _Waiting) -> None:
        is_cancelled = self._sequencer is None  # entries of a log go to all servers in any case
        self._sender.discard(waiting.part, waiting.call, is_cancelled=is_cancelled)

    def _receive_news(self, message: Message) -> None:
        news, name = News.from_wire(message.delivered.message), Name(message.delivered.publisher)
        server = self._discovery.servers.get(name)
        at = news.part - len(self.parts.services)
        if server is None or self._goals is None or not 0 <= at < len(server.news):
            return
        raw = server.news[at].decode(news.body)
        if at > 0:
            self._tell_status(self._goals.statuses(name, raw))
        elif self._goals.may_feed(name, raw):
            self._virtual_server.publish(at, raw)

    def _tell_status(self, raw: bytes | None) -> None:
        if raw is not None:
            self._virtual_server.publish(-1, raw)

    def _refuse(self, waiting: _Waiting, fault: Fault, reason: str) -> None:
        self.report(fault, reason)
        self._virtual_server.refuse(waiting.handle, waiting.ticket, reason)
