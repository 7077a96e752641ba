"""What every flow of a bridge works with.

Place: shell.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.client.participant import Participant
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Fault, Faults
from proxy.endpoints.endpoint import EndpointError

__all__ = ["BridgeContext"]


@dataclass(frozen=True, slots=True)
class BridgeContext:
    """One proxy: its hold on the overlay, what it has carried, and where its faults are told."""

    member: Participant
    traffic: Traffic
    faults: Faults

    def tell(self, what: str, event: EndpointError, fault: Fault) -> None:
        """Tell what an endpoint says of a local name: ``fault``, unless it is the whole graph that cannot be had."""
        self.faults.report(what, Fault.NO_GRAPH if event.is_graph else fault, event.reason)
