"""Nodes that cross by one rule: their description goes to the machines that may call it, and its silence is a server's.

I/O through the overlay's participant. The description lists the nodes' entities, which cross as rules of their own
(``core/node_rules.py``). All nodes of a rule share one name, so that a graph at rest costs the reports of one service,
whatever its size. A change is sent at once to all; a client whose digest differs asks for the whole state, as in
``gdp/exchange`` (Demers et al., 1987). A client describes what it uses, so that nothing else is advertised. New nodes
appear one a tick: a node of rclpy with its entities takes tens of milliseconds, in which nothing else is carried.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from gdp.client.participant import Message, Topic
from gdp.client.writer_proxy import WriterProxy
from gdp.errors import LocalError
from gdp.intervals import FORGET_S, PROMPT_S, RETRY_S
from gdp.names import Name
from gdp.requests import Backoff, Requests
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.bridge_election import presence_of_node, presence_of_nodes, sign
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.node_rules import FarNode, described, local_ends, local_node
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.service_flow import ServiceFlow
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import EndpointError, Event, GraphEntity, Role
from proxy.wire.node import NODES_MAX, WANTED_MAX, NodeEntity, NodesChange, NodeSet, NodesWanted, Wanted

_ASKS: Final = Backoff(RETRY_S, FORGET_S)  # for the whole state, which a slow path takes long for


class NodeFlow(ServiceFlow):
    """What exposed and imported nodes share: no requests of ROS, and a sign for other proxies of the graph."""

    def __init__(
        self, context: BridgeContext, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        self._mark = self._sign(presence_of_nodes(self.name))

    def handle_event(self, event: Event, now_s: float) -> None:
        """Report a fault of the sign."""
        del now_s
        if isinstance(event, EndpointError):
            self.context.report_error(self.flow_spec.local, event, Fault.REFUSED)

    def peers(self) -> list[WriterProxy]:
        """Return the far parties that report now."""
        member = self.context.member
        peers = set(member.services.peers(self.name))
        proxies = member.subscriptions.writer_proxies_of(self.name) if peers else []
        return [each for each in proxies if each.publisher in peers]

    def handle_timer(self, now_s: float) -> None:
        """Do nothing between ticks."""

    def get_timer(self) -> None:
        """Return None: it has no timer but the tick."""

    def close(self, now_s: float) -> None:
        """Withdraw the nodes."""
        del now_s
        self.dispatcher.close(self._mark)
        self.context.member.withdraw(self.name)

    def _sign(self, topic: str) -> int:
        return self.dispatcher.advertise(self, sign(topic, self.dispatcher.endpoint.ros))


class ExposedNodes(NodeFlow):
    """Describes the local nodes of a rule to remote machines.

    Attributes:
        wanted: what these use of the nodes.
    """

    far_role = "client"

    def __init__(
        self,
        context: BridgeContext,
        dispatcher: EndpointDispatcher,
        flow_spec: FlowSpec,
        topic: Topic,
        nodes: Mapping[str, Sequence[GraphEntity]],
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        self.wanted: frozenset[Wanted] = frozenset()
        self._of_clients: dict[bytes, frozenset[Wanted]] = {}  # by description
        self._state = NodeSet()
        self._state.replace(self._described(nodes))
        self._publisher = context.member.serve(topic, self._state.digest, **self.options())

    def follow(self, nodes: Mapping[str, Sequence[GraphEntity]]) -> None:
        """Send what has changed of the nodes."""
        described_nodes = self._described(nodes)
        if described_nodes == self._state.nodes:
            return
        change = self._state.replace(described_nodes)
        self._publisher.describe(self._state.digest)
        if self._publisher.is_wanted and self._publisher.has_space():
            self._publisher.publish(change.to_cbor())

    def receive(self, message: Message, now_s: float) -> None:
        """Send the whole state to a client that asks this server for it."""
        del now_s
        member, client = self.context.member, Name(message.delivered.publisher)
        if message.delivered.message != member.name:
            return
        try:
            member.services.respond(self.name, client, self._state.whole().to_cbor())
        except LocalError as error:
            self.report(Fault.REFUSED, str(error))  # the client repeats itself

    def tick(self, now_s: float) -> None:
        """Compare what clients want with what they wanted before."""
        descriptions = {each.description for each in self.peers()}
        known, self._of_clients = self._of_clients, {}
        for each in descriptions:
            if each in known:
                self._of_clients[each] = known[each]
            elif each:
                self._of_clients[each] = frozenset()
                self.context.contain(self.flow_spec.local, b"", now_s, self._read, each)
        wanted = frozenset[Wanted]().union(*self._of_clients.values())
        if wanted != self.wanted:
            self.wanted, self.has_changed = wanted, True

    def _read(self, description: bytes) -> None:
        self._of_clients[description] = frozenset(NodesWanted.from_cbor(description).names)

    def _described(self, nodes: Mapping[str, Sequence[GraphEntity]]) -> dict[str, tuple[NodeEntity, ...]]:
        rule = self.flow_spec.rule
        if len(nodes) > NODES_MAX:
            self.report(Fault.TOO_LARGE, f"{len(nodes)} nodes; a rule brings the first {NODES_MAX}: use several rules")
        return {rule.global_name_of(node): described(rule, nodes[node]) for node in sorted(nodes)[:NODES_MAX]}


class ImportedNodes(NodeFlow):
    """Knows the remote nodes of a rule while their machines report.

    Attributes:
        nodes: as they appear here, each with its rule and its entities; empty while no machine describes them.
    """

    far_role = "server"

    def __init__(
        self, context: BridgeContext, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        self.nodes: Mapping[str, FarNode] = {}
        self._rules: Sequence[Rule] = [flow_spec.rule]
        self._publisher = context.member.call(topic, NodesWanted().to_cbor(), **self.options())
        self._states: dict[Name, tuple[int, NodeSet]] = {}  # of each server, in its incarnation
        self._present: list[NodeSet] = []  # of those that report
        self._asks = Requests[Name]()
        self._shown: tuple[bytes, ...] | None = ()  # digests of the states in ``_found``; None: it is to be made again
        self._found: Mapping[str, FarNode] = {}  # all of them, also those that do not appear yet
        self._marks: dict[str, int] = {}

    @property
    def hears(self) -> frozenset[str]:
        """Return the topics to which the nodes subscribe, as all sides know them."""
        of_nodes = (each for state in self._present for entities in state.nodes.values() for each in entities)
        return frozenset(each.name for each in of_nodes if each.role is Role.SUBSCRIBES)

    def follow(self, rules: Sequence[Rule]) -> None:
        """Update the rules that say which of the nodes appear here."""
        if rules != self._rules:
            self._rules, self._shown = rules, None

    def want(self, names: Iterable[Wanted]) -> None:
        """Tell the servers what is used here."""
        wanted = sorted(names)
        if len(wanted) > WANTED_MAX:
            self.report(Fault.TOO_LARGE, f"{len(wanted)} names of far nodes are used; the first {WANTED_MAX} cross")
        self._publisher.describe(NodesWanted(tuple(wanted)).to_cbor())

    def receive(self, message: Message, now_s: float) -> None:
        """Process a change, or the whole state, of a server's nodes."""
        delivered = message.delivered
        self.context.contain(self.flow_spec.local, delivered.publisher, now_s, self._receive, message)

    def tick(self, now_s: float) -> None:
        """Compare what is known of each machine that reports with its digest."""
        for node in self._marks.keys() - self.nodes.keys():  # they no longer appear
            self.dispatcher.close(self._marks.pop(node))
        connected = {each.publisher for each in self.context.member.subscriptions.writer_proxies_of(self.name)}
        for party in self._states.keys() - connected:
            del self._states[party]
            self._asks.cancel(party)
        self._present = []
        for each in self.peers():
            self._present.append(state := self._state_of(each.publisher, each.incarnation))
            if each.description == state.digest:
                self._asks.cancel(each.publisher)
            elif each.publisher not in self._asks:  # nothing is known, or the change that is announced does not come
                self._asks.start(each.publisher, now_s + PROMPT_S if state.digest else now_s)
        for party in self._asks.poll_due(now_s):
            self._asks.sent(party, now_s, _ASKS)
            self._publisher.publish(party)
        shown = tuple(state.digest for state in self._present)
        if shown != self._shown:
            self._shown, self._found = shown, self._local_nodes()
        later = set(sorted(self._found.keys() - self.nodes.keys())[1:])
        nodes = {node: each for node, each in self._found.items() if node not in later}
        if nodes != self.nodes:
            self.nodes, self.has_changed = nodes, True
            for node in nodes.keys() - self._marks.keys():
                self._marks[node] = self._sign(presence_of_node(node))

    def close(self, now_s: float) -> None:
        """Forget the nodes."""
        super().close(now_s)
        for mark in self._marks.values():
            self.dispatcher.close(mark)

    def _receive(self, message: Message) -> None:
        change = NodesChange.from_cbor(message.delivered.message)
        if (known := self._states.get(Name(message.delivered.publisher))) is not None:
            known[1].apply(change)  # of another state: the digest tells

    def _state_of(self, party: Name, incarnation: int) -> NodeSet:
        known = self._states.get(party)
        if known is None or known[0] != incarnation:
            known = self._states[party] = incarnation, NodeSet()
            self._asks.cancel(party)
        return known[1]

    def _local_nodes(self) -> dict[str, FarNode]:
        found, owner = dict[str, FarNode](), self.flow_spec.rule.owner
        rules = [rule for rule in self._rules if rule.kind == "node" and rule.owner == owner]
        for state in self._present:
            for shared, entities in state.nodes.items():
                if (meant := local_node(rules, shared)) is not None:
                    node, rule = meant
                    before = found[node][1] if node in found else frozenset()
                    found[node] = rule, before | frozenset(local_ends(rule, node, entities))
        return found
