"""Bridge: all flows of a proxy, which begin and end as local nodes, rules and delegations change.

I/O through endpoints and the participant. The loop that drives the bridge calls ``work`` after every step.

Outgoing path: endpoint -> ``EndpointDispatcher.deliver`` -> flow -> ``Publisher.publish``.
Incoming path: ``poll_messages`` -> the flow of the name -> ``RosEndpoint.publish``, ``call`` or ``answer``.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple, Protocol, TypeAlias

from gdp.client.participant import Message, Topic
from gdp.due_queue import earliest
from gdp.errors import LocalError
from gdp.intervals import LOOK_S
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.sansio import Timestamps
from gdp.trust.right import Right
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.bridge_election import SIGN, BridgeElection, presence_of, presence_of_nodes, sign
from proxy.bridge.core.desired_flows import ConfigProblem, DeniedName, FlowSpec, RuleMemo, denied, exposed, imported
from proxy.bridge.core.exclusive_control import ExclusiveControl
from proxy.bridge.core.node_rules import Brought, FarNodes, brought, nodes_in
from proxy.bridge.core.stream_qos import LiveQos
from proxy.bridge.core.topic_stats import TopicStats
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.exposed_service import ExposedService
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.faults import Fault
from proxy.bridge.imported_service import ImportedService
from proxy.bridge.imported_topic import ImportedTopic
from proxy.bridge.liveliness import NameLiveliness
from proxy.bridge.node_flow import ExposedNodes, ImportedNodes
from proxy.bridge.readiness import ReadinessProbe
from proxy.bridge.sent_stats import SentStats
from proxy.bridge.status_topic import StatusTopic, open_status_topics
from proxy.config.brought_rule import BroughtRule, stated
from proxy.config.rule import Rule
from proxy.config.status_topic import StatusTopicConfig
from proxy.endpoints.core.endpoint import (
    EndpointError,
    Event,
    Graph,
    GraphEntity,
    NodeHost,
    Role,
    RosEndpoint,
    proxy_node_name,
)
from proxy.serial.channel import Qos
from proxy.wire.node import Wanted

log = logging.getLogger(__name__)

_ENDED_MAX: Final = 256
_FINISH_S: Final = 10.0  # in which readers may confirm the last messages of a publisher or server that has gone
_CHANGES_MAX: Final = 512  # of unread flow changes; a bridge of a recording never reads them

Flow: TypeAlias = ExposedTopic | ImportedTopic | ExposedService | ImportedService | ExposedNodes | ImportedNodes
_Timed: TypeAlias = ExposedService | ImportedService | ExposedNodes | ImportedNodes


class BridgeRules(Protocol):
    """Rules of a bridge: those of ``proxy.yaml``, or of a recording."""

    @property
    def expose(self) -> Sequence[Rule]:
        """Return the rules for what leaves this machine."""

    @property
    def imports(self) -> Sequence[Rule]:
        """Return the rules for what comes from other machines."""

    def endpoint_of(self, rule: Rule) -> int:
        """Return the number of the endpoint to which a rule applies."""


class FlowChange(NamedTuple):
    """A flow that began, or that ended."""

    flow_spec: FlowSpec
    is_begun: bool


class _Finishing(NamedTuple):
    """A flow whose local publisher or server has gone, until readers have confirmed its last messages."""

    flow_spec: FlowSpec
    flow: ExposedTopic | ExposedService
    ends_s: float


class _Key(NamedTuple):
    dispatcher: int
    is_exposed: bool
    kind: str
    local: str
    name: Name


class _View:
    """Snapshot of one graph."""

    def __init__(self, graph: Graph, me: str, expose: Sequence[Rule] = ()) -> None:
        self.graph = graph
        self.conflicts = BridgeElection(me, graph)
        self._ends: dict[tuple[Role, str, str], list[GraphEntity]] = {}
        for end in graph:
            if not end.is_proxy:
                self._ends.setdefault((end.role, end.name, end.type_name), []).append(end)
        self._nodes = nodes_in(expose, graph)

    def ends(self, role: Role, flow_spec: FlowSpec) -> Sequence[GraphEntity]:
        """Return the entities of this role, other than those of proxies, under the flow's local name."""
        return self._ends.get((role, flow_spec.local, flow_spec.type_name), ())

    def nodes_of(self, rule: Rule) -> Mapping[str, Sequence[GraphEntity]]:
        """Return the local nodes of a rule, with their entities."""
        return {node: ends for node, (its, ends) in self._nodes.items() if its is rule}


class _Signboard:
    """Owner of the presence topic by which other proxies detect this one."""

    def handle_event(self, event: Event, now_s: float) -> None:
        """Report a fault of the presence topic: without it two proxies may both carry a name for a moment."""
        del now_s
        if isinstance(event, EndpointError):
            log.warning("no sign for other proxies reason=%s", event.reason)


class Bridge:
    """Carries the flows of the rules between endpoints and the overlay.

    Args:
        endpoints: numbered as in the rules, in the order of the configuration's ``ros`` section.
        status_topic: where local nodes read the parties of names; None: nowhere.
        look_s: seconds of observation before any flow begins: graphs need them to show the other proxies.

    Attributes:
        held: the delegations in use.
        rules: the present ones.
        problems: why names that rules name are not carried at present.
    """

    def __init__(
        self,
        context: BridgeContext,
        config: BridgeRules,
        endpoints: Sequence[RosEndpoint],
        held: DelegationStore,
        *,
        look_s: float = 0.0,
        status_topic: StatusTopicConfig | None = None,
    ) -> None:
        self._context = context
        self.rules = config
        self.held = held
        self._me = proxy_node_name(context.member.name.to_text())
        self._dispatchers = [EndpointDispatcher(endpoint) for endpoint in endpoints]
        self._memos = [RuleMemo() for _ in endpoints]
        self._flows: dict[_Key, tuple[FlowSpec, Flow]] = {}
        self._inbound: dict[Name, Flow] = {}  # the flow that receives the overlay's messages of a name
        self._finishing: dict[Name, _Finishing] = {}
        self._timed: dict[_Timed, str] = {}  # to its local name
        self._far_nodes: list[FarNodes] = [{} for _ in endpoints]  # by endpoint, as they appear
        self._wanted = set[Wanted]()  # by far machines, of what local nodes have
        self._timed_topics: dict[ExposedTopic | ImportedTopic, str] = {}  # to their local names
        self._probes: dict[_Key, ReadinessProbe] = {}  # of local servers, whether their flow has begun or not
        self._since: dict[_Key, float] = {}  # desired flows that wait for other proxies to begin
        self._flow_begun_s: dict[_Key, float] = {}
        self._failed: dict[_Key, ConfigProblem] = {}  # flows that this graph does not allow at present
        self._undelegated: dict[_Key, FlowSpec] = {}  # failed flows that wait for a delegation
        self.problems: set[ConfigProblem] = set()
        self._ended = deque[TopicStats](maxlen=_ENDED_MAX)
        self._changes = deque[FlowChange](maxlen=_CHANGES_MAX)
        self._is_stale = True
        self._look_s = look_s
        self._begun_s: float | None = None  # time of the first refresh
        self._tick_at_s = 0.0
        self._now_s = 0.0
        live = [
            dispatcher for dispatcher in self._dispatchers if dispatcher.endpoint.is_live and status_topic is not None
        ]
        self._status_topics: list[StatusTopic] = [] if status_topic is None else open_status_topics(live, status_topic)
        for dispatcher in self._dispatchers:
            if not dispatcher.endpoint.is_live:
                continue  # no other proxy takes part in a recording
            try:
                dispatcher.advertise(_Signboard(), sign(SIGN, dispatcher.endpoint.ros))
            except LocalError as error:
                log.warning("no sign for other proxies endpoint=%s reason=%s", dispatcher.endpoint.label, error)

    @property
    def flows(self) -> list[tuple[FlowSpec, Flow]]:
        """Return the present flows."""
        return list(self._flows.values())

    def graphs(self) -> list[Graph]:
        """Return the entities of each graph, in the order of the configuration."""
        return [dispatcher.graph() for dispatcher in self._dispatchers]

    def flow_of(self, rule: Rule, local: str, name: Name) -> tuple[Flow, float] | None:
        """Return the flow of a local name under a rule, and when it began, monotonic seconds; None: there is none."""
        for key, (flow_spec, flow) in self._flows.items():
            if (flow_spec.rule, flow_spec.local, flow_spec.name) == (rule, local, name):
                return flow, self._flow_begun_s[key]
        return None

    @property
    def labels(self) -> list[str]:
        """Return the display names of the graphs."""
        return [dispatcher.endpoint.label for dispatcher in self._dispatchers]

    @property
    def brought(self) -> Brought:
        """Return the rules of what the nodes have that rules are about."""
        rules = Brought([], [])
        for at, dispatcher in enumerate(self._dispatchers):
            here = self._brought(at, self._exposed_at(at), dispatcher.graph())
            rules.expose.extend(here.expose)
            rules.imports.extend(here.imports)
        return rules

    @property
    def stats(self) -> list[TopicStats]:
        """Return the statistics of every incoming topic, including topics that ended."""
        imported = [flow for _, flow in self.flows if isinstance(flow, ImportedTopic)]
        for flow in imported:
            flow.count_losses()
        return [*self._ended, *(flow.stats for flow in imported)]

    @property
    def best_effort(self) -> list[SentStats]:
        """Return the statistics of the best-effort topics that are exposed now."""
        exposed = [(spec.local, flow.publisher) for spec, flow in self.flows if isinstance(flow, ExposedTopic)]
        return [SentStats.of(local, each) for local, each in exposed if each is not None and not each.confirms]

    def answered_by(self, name: Name) -> Name | None:
        """Return the server whose response ended the latest call of a service; None: there was no response."""
        flow = self._inbound.get(name)
        return flow.answered_by if isinstance(flow, ImportedService) else None

    def controlled(self, name: Name) -> tuple[ImportedTopic, ExclusiveControl] | None:
        """Return the flow of a topic that is under exclusive control here, and its control, or None."""
        flow = self._inbound.get(name)
        return (flow, flow.control) if isinstance(flow, ImportedTopic) and flow.control is not None else None

    def publishers_of(self, name: Name) -> list[Name]:
        """Return the remote publishers of a topic that is read here, as far as they have introduced themselves."""
        return [each.publisher for each in self._context.member.subscriptions.writer_proxies_of(name)]

    @property
    def undelegated(self) -> list[FlowSpec]:
        """Return the flows that only lack a delegation."""
        return [flow_spec for key, flow_spec in self._undelegated.items() if key in self._failed]

    @property
    def offered_qos(self) -> list[tuple[FlowSpec, Qos]]:
        """Return the QoS of the live topics that are exposed, or only lack a delegation for it; unknown ones miss."""
        found = [(spec, flow.qos.profile) for spec, flow in self.flows if isinstance(flow, ExposedTopic)]
        lacking = [spec for spec in self.undelegated if spec.is_exposed and spec.rule.kind == "topic"]
        for view in [_View(graph, self._me) for graph in self.graphs()] if lacking else ():
            found += [(spec, LiveQos(spec.rule, view.ends(Role.PUBLISHES, spec)).profile) for spec in lacking]
        return [(spec, profile) for spec, profile in found if profile is not None]

    @property
    def denied(self) -> list[DeniedName]:
        """Return the local names that rules are about, and that ``deny`` keeps local."""
        found = list[DeniedName]()
        for at, dispatcher in enumerate(self._dispatchers):
            graph = dispatcher.graph()
            for rules, is_exposed in ((self.rules.expose, True), (self.rules.imports, False)):
                here = [rule for rule in rules if self.rules.endpoint_of(rule) == at]
                found += denied(here, graph, is_exposed=is_exposed)
        return found

    def liveliness(self, now_s: float) -> list[NameLiveliness]:
        """Return the parties of every name that is carried."""
        return [
            NameLiveliness(
                kind=spec.rule.kind,
                local=spec.local,
                shared=spec.rule.global_name_of(spec.local),
                is_exposed=spec.is_exposed,
                is_joined=not isinstance(flow, ImportedTopic) or flow.is_joined,
                parties=flow.parties(now_s),
            )
            for spec, flow in self.flows
        ]

    @property
    def unready(self) -> list[tuple[str, str]]:
        """Return the local servers whose probe does not pass, each with the reason."""
        return [(key.local, probe.reason) for key, probe in self._probes.items() if not probe.is_ready]

    @property
    def is_settled(self) -> bool:
        """Return whether no flow waits to begin."""
        return not self._is_stale and not self._since

    def work(self, now_s: float) -> None:
        """Process events of endpoints and messages of the overlay, and run due timers."""
        self._now_s = now_s
        for dispatcher in self._dispatchers:
            if dispatcher.deliver(self._context, now_s):
                self._is_stale = True
                self._failed.clear()
        for message in self._context.member.poll_messages():
            self._receive(message, now_s)
        for key, probe in self._probes.items():
            probe.handle_timer(now_s)
            if probe.poll_changed():
                self._is_stale = True
                log.info("server ready=%s kind=%s reason=%s", probe.is_ready, key.kind, probe.reason or "probe passed")
        if self._is_stale or (self._since and now_s >= self._tick_at_s):
            self._refresh(now_s)
        for dispatcher in self._dispatchers:
            dispatcher.deliver_faults(self._context, now_s)
        self._close_finished(now_s)
        if self._context.keeper is not None:
            self._context.keeper.handle(Timestamps(now_s, time.time()), self._context.faults)
        is_tick = now_s >= self._tick_at_s
        for flow, local in self._timed.items():
            due_s = flow.get_timer()
            if is_tick:
                self._context.contain(local, b"", now_s, flow.tick, now_s)
                self._is_stale |= flow.poll_changed()
            elif due_s is not None and due_s <= now_s:
                self._context.contain(local, b"", now_s, flow.handle_timer, now_s)
        for topic, local in self._timed_topics.items():
            due_s = topic.get_timer()
            if due_s is not None and due_s <= now_s:
                self._context.contain(local, b"", now_s, topic.handle_timer, now_s)
        for status_topic in self._status_topics:
            if status_topic.is_due(now_s):
                status_topic.update(self.liveliness(now_s), now_s)
        if is_tick:
            self._tick_at_s = now_s + LOOK_S
            self._context.traffic.dropped = sum(dispatcher.endpoint.dropped for dispatcher in self._dispatchers)

    def poll_changes(self) -> list[FlowChange]:
        """Return the flows that began or ended since the last call, in order; the oldest are forgotten first."""
        changes = list(self._changes)
        self._changes.clear()
        return changes

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self._is_stale:
            return 0.0
        has_ticks = bool(self._timed or self._probes or self._since or self._finishing)
        times = [each.get_timer() for each in (*self._timed, *self._probes.values(), *self._timed_topics)]
        if self._context.keeper is not None:
            times.append(self._context.keeper.get_timer())
        return earliest(*times, self._tick_at_s if has_ticks else None)

    def reload(self, config: BridgeRules, held: DelegationStore) -> None:
        """Replace rules and delegations; flows with an unchanged rule continue undisturbed while they are delegated."""
        self.rules, self.held, self._memos = config, held, [RuleMemo() for _ in self._dispatchers]
        if self._context.keeper is not None:
            self._context.keeper.renew(held)
        for key, (flow_spec, flow) in list(self._flows.items()):
            topic = held.find(flow_spec.name, flow_spec.right)
            if topic is None:
                self._end(key)
            else:
                flow.renew(topic)
        self._failed.clear()
        self._is_stale = True

    def drain(self, now_s: float) -> None:
        """Refuse new requests of clients to the servers here; requests under way are answered."""
        for _, flow in self.flows:
            if isinstance(flow, ExposedService):
                flow.drain(now_s)

    def is_drained(self, now_s: float) -> bool:
        """Return whether clients have the responses of every server here to all requests before ``drain``."""
        return all(flow.is_drained(now_s) for _, flow in self.flows if isinstance(flow, ExposedService))

    def finish(self) -> None:
        """End every flow, as if the local nodes had gone; ``is_finished`` when remote readers have confirmed all."""
        for key in list(self._flows):
            self._finish(key)

    @property
    def is_finished(self) -> bool:
        """Return whether readers have confirmed the last messages of all flows that ended."""
        return all(self._context.member.publications.is_acknowledged(name) for name in self._finishing)

    def close(self) -> None:
        """End every flow; endpoints stay open."""
        for key in list(self._flows):
            self._end(key)
        for name in list(self._finishing):
            self._close_finishing(name)
        for probe in self._probes.values():
            probe.close()
        self._probes.clear()
        for topic in self._status_topics:
            topic.close()
        self._status_topics = []

    def _receive(self, message: Message, now_s: float) -> None:
        flow, keeper = self._inbound.get(message.topic), self._context.keeper
        if flow is None and keeper is not None and keeper.capsules.is_asked(message.topic):
            self._context.contain("a holder", message.delivered.publisher, now_s, keeper.receive, message, now_s)
        elif flow is None or isinstance(flow, ExposedTopic):
            self._context.traffic.unread += 1  # its flow ended a moment ago
        else:
            flow.receive(message, now_s)

    def _refresh(self, now_s: float) -> None:
        """Begin desired flows, end flows that are no longer desired, and pass the graph to the others."""
        self._is_stale = False
        complaints = list[ConfigProblem]()
        wished, shown = set[_Key](), set[_Key]()
        self._wanted = {name for flow in self._timed if isinstance(flow, ExposedNodes) for name in flow.wanted}
        for at, dispatcher in enumerate(self._dispatchers):
            view = _View(dispatcher.graph(), self._me, self._exposed_at(at))
            far_nodes = self._far(at)
            self._show(at, {**self._far_nodes[at], **far_nodes})  # before what they own
            for flow_spec in self._flow_specs(at, view.graph, complaints):
                key = _Key(at, flow_spec.is_exposed, flow_spec.rule.kind, flow_spec.local, flow_spec.name)
                shown.add(key)
                if not self._context.contain(
                    flow_spec.local, b"", now_s, self._refresh_flow, key, flow_spec, view, now_s, wished, complaints
                ):
                    wished.add(key)
                    if key in self._flows:
                        self._end(key)
                    self._failed[key] = ConfigProblem(flow_spec.local, Fault.REFUSED, "an error here; see the log")
                    complaints.append(self._failed[key])
        for key in [key for key in self._flows if key not in wished]:
            if key in shown or not self._may_finish(key):
                self._end(key)
            else:
                self._finish(key)
        for at in range(len(self._dispatchers)):
            self._show(at, self._far(at))
            self._want(at)
        for key in [key for key in self._probes if key not in wished]:
            self._probes.pop(key).close()
        self._since = {key: since for key, since in self._since.items() if key in wished}
        self._undelegated = {key: each for key, each in self._undelegated.items() if key in wished}
        self._tell(complaints)

    def _refresh_flow(
        self,
        key: _Key,
        flow_spec: FlowSpec,
        view: _View,
        now_s: float,
        wished: set[_Key],
        complaints: list[ConfigProblem],
    ) -> None:
        """Begin a desired flow when it is our turn, and pass the graph to it."""
        conflict = view.conflicts.before_us(_shown_as(flow_spec), is_begun=key in self._flows)
        if conflict:
            complaints.append(
                ConfigProblem(flow_spec.local, Fault.OTHER_BRIDGE, f"{conflict} carries it in this graph")
            )
            return
        wished.add(key)
        before = self._flows.get(key, (flow_spec,))[0]
        if before is not flow_spec and before.rule != flow_spec.rule:
            self._change(key, flow_spec)
        if not self._is_ready(key, flow_spec, now_s):
            if key in self._flows:
                self._finish(key)
            self._since.pop(key, None)
            complaints += [self._failed[key]] if key in self._failed else []
            return
        if key not in self._flows and key not in self._failed and self._is_our_turn(key, view, now_s):
            self._begin(key, flow_spec, view)
        try:
            self._follow(key, flow_spec, view, now_s)
        except LocalError as error:
            self._end(key)
            self._failed[key] = ConfigProblem(flow_spec.local, Fault.NO_GRAPH, str(error))
        complaints += [self._failed[key]] if key in self._failed else []

    def _is_ready(self, key: _Key, flow_spec: FlowSpec, now_s: float) -> bool:
        """Return whether a far machine wants it, if it must, and the local server's probe passes, if it has one."""
        if not self._is_wanted(flow_spec):
            self._may_use(key, flow_spec)
            return False
        settings = flow_spec.rule.readiness
        probe = self._probes.get(key)
        if probe is not None and probe.settings != settings:
            self._probes.pop(key).close()
            probe = None
        if settings is None or not flow_spec.is_exposed:
            return True
        if probe is None:
            try:
                probe = self._probes[key] = ReadinessProbe(self._dispatchers[key.dispatcher], settings, now_s)
            except LocalError as error:
                self._failed[key] = ConfigProblem(flow_spec.local, Fault.UNKNOWN_TYPE, f"readiness: {error}")
                return False
        return probe.is_ready

    def _is_wanted(self, flow_spec: FlowSpec) -> bool:
        """Return whether a flow is to exist: what a pattern of local nodes brings does while a far machine uses it."""
        rule = flow_spec.rule
        if not isinstance(rule, BroughtRule) or not rule.awaits_demand:
            return True
        return (rule.kind, rule.global_name_of(flow_spec.local)) in self._wanted

    def _want(self, at: int) -> None:
        """State what is used here of the far nodes of patterns."""
        for _, nodes in self._imported_nodes(at):
            hears, wanted = nodes.hears, set[Wanted]()
            rules = {id(rule) for rule, _ in nodes.nodes.values()}
            for flow_spec, flow in self._flows.values():
                kind, shared = flow_spec.rule.kind, flow_spec.rule.global_name_of(flow_spec.local)
                if kind == "node":
                    continue
                is_given = isinstance(flow, ExposedTopic) and shared in hears
                is_taken = isinstance(flow, ImportedTopic | ImportedService) and flow.is_joined
                if is_given or (is_taken and id(stated(flow_spec.rule)) in rules):
                    wanted.add((kind, shared))
            nodes.want(wanted)

    def _is_our_turn(self, key: _Key, view: _View, now_s: float) -> bool:
        """Return whether higher-ranked proxies of this graph had time to show themselves and to begin."""
        self._begun_s = now_s if self._begun_s is None else self._begun_s
        ours_s = self._since.setdefault(key, now_s) + view.conflicts.patience_s
        if now_s < max(ours_s, self._begun_s + self._look_s):
            return False
        del self._since[key]
        return True

    def _follow(self, key: _Key, flow_spec: FlowSpec, view: _View, now_s: float) -> None:
        _, flow = self._flows.get(key, (flow_spec, None))
        if isinstance(flow, ExposedTopic):
            flow.follow(view.ends(Role.PUBLISHES, flow_spec))
            if flow.qos.asks_depth:  # it may have a timer while its local publishers stay
                self._timed_topics[flow] = flow_spec.local
            else:
                self._timed_topics.pop(flow, None)
        elif isinstance(flow, ImportedTopic):
            flow.follow(view.ends(Role.SUBSCRIBES, flow_spec))
            if flow.has_lease:
                self._timed_topics[flow] = flow_spec.local
        elif isinstance(flow, ExposedService):
            flow.follow(view.ends(Role.SERVES, flow_spec), now_s)
        elif isinstance(flow, ExposedNodes):
            flow.follow(view.nodes_of(flow_spec.rule))
        elif isinstance(flow, ImportedNodes):
            flow.follow(self.rules.imports)

    def _flow_specs(self, at: int, graph: Graph, complaints: list[ConfigProblem]) -> Iterator[FlowSpec]:
        expose = self._exposed_at(at)
        imports = [rule for rule in self.rules.imports if self.rules.endpoint_of(rule) == at]
        nodes = self._brought(at, expose, graph)
        yield from exposed(expose, graph, complaints, nodes.expose, self._memos[at])
        held = [*self.held.described(Right.READ), *self.held.described(Right.CALL)]
        yield from imported(imports, graph, held, complaints, nodes.imports, self._memos[at])

    def _exposed_at(self, at: int) -> list[Rule]:
        return [rule for rule in self.rules.expose if self.rules.endpoint_of(rule) == at]

    def _brought(self, at: int, expose: Sequence[Rule], graph: Graph) -> Brought:
        return brought(expose, graph, [each for _, flow in self._imported_nodes(at) for each in flow.nodes.values()])

    def _imported_nodes(self, at: int) -> Iterator[tuple[FlowSpec, ImportedNodes]]:
        for key, (flow_spec, flow) in self._flows.items():
            if key.dispatcher == at and isinstance(flow, ImportedNodes):
                yield flow_spec, flow

    def _far(self, at: int) -> FarNodes:
        """Return the far nodes that are described now."""
        return {node: ends for _, flow in self._imported_nodes(at) for node, (_, ends) in flow.nodes.items()}

    def _show(self, at: int, far_nodes: FarNodes) -> None:
        """Have far nodes appear in a graph."""
        endpoint = self._dispatchers[at].endpoint
        if far_nodes == self._far_nodes[at]:
            return
        self._far_nodes[at] = far_nodes
        if isinstance(endpoint, NodeHost):
            endpoint.set_nodes(far_nodes)
            return
        for name in far_nodes:
            detail = "far nodes do not appear in this graph; what they have crosses"
            self._context.faults.report(name, Fault.REFUSED, detail)

    def _begin(self, key: _Key, flow_spec: FlowSpec, view: _View) -> None:
        """Begin a flow, or record why this graph does not allow it."""
        topic = self._may_use(key, flow_spec)
        if topic is None:
            return
        if self._bypasses_control(key, flow_spec):
            detail = "a rule has this topic under exclusive control, and another name brings it, too: use one name"
            self._failed[key] = ConfigProblem(flow_spec.local, Fault.REFUSED, detail)
            return
        if flow_spec.name in self._finishing:
            self._close_finishing(flow_spec.name)
        try:
            flow = self._make(self._dispatchers[key.dispatcher], flow_spec, topic, view)
        except LocalError as error:
            self._failed[key] = ConfigProblem(flow_spec.local, Fault.UNKNOWN_TYPE, str(error))
            return
        self._flows[key] = flow_spec, flow
        self._flow_begun_s[key] = self._now_s
        if not isinstance(flow, ExposedTopic):
            self._inbound[flow_spec.name] = flow
        if isinstance(flow, _Timed):
            self._timed[flow] = flow_spec.local
        if isinstance(flow, ImportedTopic) and flow.control is not None:
            self._timed_topics[flow] = flow_spec.local
        self._changes.append(FlowChange(flow_spec, is_begun=True))
        log.debug("flow begun name=%s exposed=%s", flow_spec.name.short, flow_spec.is_exposed)

    def _may_use(self, key: _Key, flow_spec: FlowSpec) -> Topic | None:
        """Return the delegation of a flow; a missing one is recorded."""
        topic = self.held.find(flow_spec.name, flow_spec.right)
        if topic is None:
            self._undelegated[key] = flow_spec
            self._failed[key] = ConfigProblem(flow_spec.local, Fault.NO_DELEGATION, self._how_to_delegate(flow_spec))
        else:
            self._undelegated.pop(key, None)
        return topic

    def _bypasses_control(self, key: _Key, flow_spec: FlowSpec) -> bool:
        """Return whether two names would bring one local topic, of which one is under exclusive control."""
        if key.is_exposed or key.kind != "topic":
            return False
        others = (its[0] for each, its in self._flows.items() if each[:-1] == key[:-1])
        return any(flow_spec.rule.control or each.rule.control for each in others)

    def _make(self, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic, view: _View) -> Flow:
        context = self._context
        if flow_spec.rule.kind == "node":
            if flow_spec.is_exposed:
                return ExposedNodes(context, dispatcher, flow_spec, topic, view.nodes_of(flow_spec.rule))
            return ImportedNodes(context, dispatcher, flow_spec, topic)
        if flow_spec.rule.kind != "topic":
            kind = ExposedService if flow_spec.is_exposed else ImportedService
            return kind(context, dispatcher, flow_spec, topic, secrets.randbits(63))
        if flow_spec.is_exposed:
            return ExposedTopic(context, dispatcher, flow_spec, topic, view.ends(Role.PUBLISHES, flow_spec))
        return ImportedTopic(context, dispatcher, flow_spec, topic)

    def _may_finish(self, key: _Key) -> bool:
        """Return whether the rule and the delegation of a flow still apply: it ends because its local node has gone."""
        flow_spec, _ = self._flows[key]
        rules = (*self.rules.expose, *self.rules.imports)
        return stated(flow_spec.rule) in rules and self.held.find(flow_spec.name, flow_spec.right) is not None

    def _finish(self, key: _Key) -> None:
        """End a flow; the last messages of an exposed one stay until readers have confirmed them."""
        flow_spec, flow = self._remove(key)
        if isinstance(flow, ExposedTopic | ExposedService):
            flow.finish(self._now_s)
            self._finishing[flow_spec.name] = _Finishing(flow_spec, flow, self._now_s + _FINISH_S)
        else:
            self._close(flow_spec, flow)

    def _change(self, key: _Key, flow_spec: FlowSpec) -> None:
        """End a flow whose rule has changed; a topic whose QoS as stated by the far side has changed continues."""
        before, flow = self._flows[key]
        is_same = before.rule.model_copy(update={"offered": flow_spec.rule.offered}) == flow_spec.rule
        if is_same and isinstance(flow, ImportedTopic):
            self._flows[key] = flow_spec, flow
            flow.set_offered(flow_spec)
        else:
            self._end(key)

    def _end(self, key: _Key) -> None:
        """End a flow at once."""
        self._close(*self._remove(key))

    def _remove(self, key: _Key) -> tuple[FlowSpec, Flow]:
        flow_spec, flow = self._flows.pop(key)
        del self._flow_begun_s[key]
        if isinstance(flow, _Timed):
            del self._timed[flow]
        if isinstance(flow, ExposedTopic | ImportedTopic):
            self._timed_topics.pop(flow, None)
        if isinstance(flow, ImportedTopic):
            self._ended.append(flow.stats)
        if isinstance(flow, ImportedNodes):
            self._is_stale = True  # what it brought ends
        self._changes.append(FlowChange(flow_spec, is_begun=False))
        return flow_spec, flow

    def _close_finished(self, now_s: float) -> None:
        for name, each in list(self._finishing.items()):
            if now_s >= each.ends_s or self._context.member.publications.is_acknowledged(name):
                self._close_finishing(name)

    def _close_finishing(self, name: Name) -> None:
        flow_spec, flow, _ = self._finishing.pop(name)
        if not self._context.member.publications.is_acknowledged(name) and (
            count := self._context.member.publications.unacknowledged(name)
        ):
            detail = f"{count} messages were not confirmed after their {flow_spec.rule.kind} had ended here"
            self._context.faults.report(flow_spec.local, Fault.UNCONFIRMED, detail)
        self._close(flow_spec, flow)

    def _close(self, flow_spec: FlowSpec, flow: Flow) -> None:
        if self._inbound.get(flow_spec.name) is flow:
            del self._inbound[flow_spec.name]
        flow.close(self._now_s)
        log.debug("flow ended name=%s exposed=%s", flow_spec.name.short, flow_spec.is_exposed)

    def _how_to_delegate(self, flow_spec: FlowSpec) -> str:
        return (
            f"no delegation to {flow_spec.right.value} [{flow_spec.type_name}] as {flow_spec.name.to_text()} in"
            f" {self.held.directory}; the owner makes all that this proxy needs with"
            " 'gdp delegate --owner OWNER --live FILE' (FILE: its proxy.yaml)"
        )

    def _tell(self, complaints: Sequence[ConfigProblem]) -> None:
        """Report new configuration problems; a problem that ended may be reported again later."""
        now = set(complaints)
        for complaint in self.problems - now:
            if complaint.fault is not Fault.UNKNOWN_TYPE and complaint.fault is not Fault.NO_DELEGATION:
                self._context.faults.clear(complaint.local, complaint.fault)
        for complaint in now - self.problems:
            self._context.faults.report(complaint.local, complaint.fault, complaint.detail)
        self.problems = now


def _shown_as(flow_spec: FlowSpec) -> str:
    """Return the local name at which other proxies see that this proxy carries the flow."""
    if flow_spec.rule.kind == "node":
        return presence_of_nodes(flow_spec.name)
    return presence_of(flow_spec.local) if flow_spec.is_exposed and flow_spec.rule.kind != "topic" else flow_spec.local
