"""Service or action that crosses: what an exposed and an imported one share.

I/O through the overlay's participant.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

from gdp.client.participant import Topic
from gdp.client.send_options import is_urgent
from gdp.trust.advertisement import paths_value, session_value
from proxy.bridge.call_tracer import CallKey
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.action_interface import ActionInterface
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.liveliness import Party, PartyRole

if TYPE_CHECKING:
    from gdp.client.participant import ServiceOptions
    from gdp.names import Name
    from proxy.endpoints.core.endpoint import Event


class ServiceFlow(ABC):
    """One service or action of a rule, between this machine and the overlay.

    Attributes:
        far_role: what the far parties are.
        requests: how many came.
        request_bytes: their bytes.
        has_changed: something has that other flows depend on.
    """

    far_role: ClassVar[PartyRole]

    def __init__(
        self, context: BridgeContext, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic
    ) -> None:
        self.context = context
        self.dispatcher = dispatcher
        self.flow_spec = flow_spec
        self.topic = topic
        self.parts = ActionInterface.of(flow_spec.rule.kind, flow_spec.local, flow_spec.type_name)
        self.requests = 0
        self.request_bytes = 0
        self.has_changed = False

    @property
    def name(self) -> Name:
        """Return the service's name in the overlay."""
        return self.topic.name

    def options(self) -> ServiceOptions:
        """Return how the rule has it served or called."""
        rule = self.flow_spec.rule
        return {
            "is_global": rule.is_global,
            "urgent": is_urgent(rule.priority),
            "paths": paths_value(rule.paths),
            "options": rule.send_options(),
            "is_session": session_value(rule.sign),
        }

    def report(self, fault: Fault, reason: str) -> None:
        """Report a fault of the service."""
        self.context.faults.report(self.flow_spec.local, fault, reason)

    def poll_changed(self) -> bool:
        """Return ``has_changed``, once."""
        has_changed, self.has_changed = self.has_changed, False
        return has_changed

    def call_key(self, client: Name, part: int, call: int) -> CallKey:
        """Return the key of a call for traces."""
        return CallKey(self.name, client, part, call)

    def own_key(self, part: int, call: int) -> CallKey:
        """Return the key of a call of this node for traces."""
        return self.call_key(self.context.member.name, part, call)

    @abstractmethod
    def handle_event(self, event: Event, now_s: float) -> None:
        """Process an event of the local graph."""

    def parties(self, now_s: float) -> list[Party]:
        """Return the far parties that are known now."""
        del now_s
        silent = set(self.context.member.services.silent_peers(self.name))
        names = dict.fromkeys([*self.context.member.services.connected_peers(self.name), *silent])
        return [Party(self.far_role, each.to_text(), is_silent=each in silent) for each in names]

    def renew(self, topic: Topic) -> None:
        """Replace the delegation."""
        self.topic = topic
        self.context.member.renew(topic)
