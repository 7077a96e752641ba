"""What every flow of a bridge works with.

Place: shell.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.client.member import Member
from proxy.endpoints.endpoint import Faulted
from proxy.faults import Fault, Faults
from proxy.traffic import Traffic

__all__ = ["Site"]


@dataclass(frozen=True, slots=True)
class Site:
    """One proxy: its hold on the overlay, what it has carried, and where its faults are told."""

    member: Member
    traffic: Traffic
    faults: Faults

    def tell(self, what: str, event: Faulted, fault: Fault) -> None:
        """Tell what an endpoint says of a local name: ``fault``, unless it is the whole graph that cannot be had."""
        self.faults.tell(what, Fault.NO_GRAPH if event.is_graph else fault, event.reason)
