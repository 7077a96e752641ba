"""Node that crosses: its description goes to the machines that may call it, and its silence is noticed as a server's.

I/O through the overlay's participant. The description lists the node's entities, which cross as rules of their own
(``core/node_rules.py``). Here a node is a service without requests: both sides see each other come and go.
"""

from __future__ import annotations

from collections.abc import Sequence

from gdp.client.participant import Message, Topic
from gdp.names import Name
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.bridge_election import presence_of, presence_of_node, sign
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.node_rules import described, local_ends
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.service_flow import ServiceFlow
from proxy.endpoints.core.endpoint import EndpointError, Event, Graph, GraphEntity
from proxy.wire.node import NodeDescription


class NodeFlow(ServiceFlow):
    """What an exposed and an imported node share: no requests, and a sign for other proxies of the graph."""

    def __init__(
        self, context: BridgeContext, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        shown = presence_of if flow_spec.is_exposed else presence_of_node
        self._mark = dispatcher.advertise(self, sign(shown(flow_spec.local), dispatcher.endpoint.ros))

    def receive(self, message: Message, now_s: float) -> None:
        """Ignore it: nothing is sent on a node's name."""

    def handle_event(self, event: Event, now_s: float) -> None:
        """Report a fault of the sign."""
        del now_s
        if isinstance(event, EndpointError):
            self.context.report_error(self.flow_spec.local, event, Fault.REFUSED)

    def close(self, now_s: float) -> None:
        """Withdraw the node."""
        del now_s
        self.dispatcher.close(self._mark)
        self.context.member.withdraw(self.name)


class ExposedNode(NodeFlow):
    """Describes one local node to remote machines while it exists."""

    far_role = "client"

    def __init__(
        self,
        context: BridgeContext,
        dispatcher: EndpointDispatcher,
        flow_spec: FlowSpec,
        topic: Topic,
        ends: Sequence[GraphEntity],
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        self._publisher = context.member.serve(topic, self._description(ends), **self.options())

    def follow(self, ends: Sequence[GraphEntity]) -> None:
        """Describe the node again, where its entities changed."""
        self._publisher.describe(self._description(ends))

    def _description(self, ends: Sequence[GraphEntity]) -> bytes:
        return NodeDescription(tuple(described(self.flow_spec.rule, ends))).to_cbor()


class ImportedNode(NodeFlow):
    """Knows one remote node while its machine reports.

    Attributes:
        ends: the node's entities, as they appear here; empty while no machine describes it.
    """

    far_role = "server"

    def __init__(
        self, context: BridgeContext, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic
    ) -> None:
        super().__init__(context, dispatcher, flow_spec, topic)
        context.member.call(topic, b"", **self.options())
        self.ends: Graph = frozenset()
        self._described: dict[Name, tuple[bytes, Graph]] = {}
        self._has_changed = False

    def poll_changed(self) -> bool:
        """Return, once, whether ``ends`` changed."""
        has_changed, self._has_changed = self._has_changed, False
        return has_changed

    def tick(self, now_s: float) -> None:
        """Compare the machines that describe the node with those that report now."""
        member, before = self.context.member, self._described
        peers = set(member.services.peers(self.name))
        self._described = {}
        for writer_proxy in member.subscriptions.writer_proxies_of(self.name) if peers else ():
            party, description = writer_proxy.publisher, writer_proxy.description
            known = before.get(party)
            if party not in peers:
                continue
            if known is None or known[0] != description:
                self._described[party] = description, frozenset()
                self.context.contain(self.flow_spec.local, party, now_s, self._read, party, description)
            else:
                self._described[party] = known
        if self._described != before:
            self._has_changed = True
            self.ends = frozenset().union(*(ends for _, ends in self._described.values()))

    def handle_timer(self, now_s: float) -> None:
        """Do nothing between ticks."""

    def get_timer(self) -> None:
        """Return None: it has no timer but the tick."""

    def _read(self, party: Name, description: bytes) -> None:
        entities = NodeDescription.from_cbor(description).entities
        ends = frozenset(local_ends(self.flow_spec.rule, self.flow_spec.local, entities))
        self._described[party] = description, ends
