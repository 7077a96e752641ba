"""Bridge context: the objects that every flow of a bridge shares.

I/O.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.client.participant import Participant
from proxy.bridge.call_tracer import CallTracer, NoTracer
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Fault, Faults
from proxy.endpoints.endpoint import EndpointError

__all__ = ["BridgeContext"]


@dataclass(frozen=True, slots=True)
class BridgeContext:
    """One proxy: its participant in the overlay, its counters, its fault reports, and who traces its calls."""

    member: Participant
    traffic: Traffic
    faults: Faults
    tracer: CallTracer = field(default_factory=NoTracer)

    def report_error(self, what: str, event: EndpointError, fault: Fault) -> None:
        """Report an endpoint's error about a local name as ``fault``, unless the whole graph is unavailable."""
        self.faults.report(what, Fault.NO_GRAPH if event.is_graph else fault, event.reason)
