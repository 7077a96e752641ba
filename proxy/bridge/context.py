"""Bridge context: the objects that every flow of a bridge shares, and the error boundary around what far parties send.

I/O: it logs.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, ParamSpec

from gdp.client.participant import Participant
from gdp.control.boundary import ErrorBoundary
from gdp.errors import DropReason, RemoteError
from gdp.message.clock_offset import ClockEstimate
from gdp.names import Name
from gdp.sansio import Timestamps
from proxy.bridge.call_tracer import CallTracer
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Fault, Faults
from proxy.bridge.keeping import TopicKeeper
from proxy.endpoints.core.endpoint import EndpointError

log = logging.getLogger(__name__)

_Input = ParamSpec("_Input")
_FAULTS: Final = {DropReason.INTERNAL: Fault.INTERNAL, DropReason.QUARANTINED: Fault.QUARANTINED}


@dataclass(frozen=True, slots=True)
class BridgeContext:
    """One proxy: its participant in the overlay, counters, fault reports, the keeper of its topics, and its tracer."""

    member: Participant
    traffic: Traffic
    faults: Faults
    keeper: TopicKeeper | None = None
    tracer: CallTracer = field(default_factory=CallTracer)
    boundary: ErrorBoundary = field(default_factory=ErrorBoundary)

    def clock_of(self, publisher: bytes, now_s: float) -> ClockEstimate | None:
        """Return what a publisher's wall clock is ahead of ours; None: that is not known."""
        return self.member.diagnostics.clock_of(Name(publisher), Timestamps(now_s, time.time()))

    def report_error(self, what: str, event: EndpointError, fault: Fault) -> None:
        """Report an endpoint's error about a local name as ``fault``, unless the whole graph is unavailable."""
        self.faults.report(what, Fault.NO_GRAPH if event.is_graph else fault, event.reason)

    def contain(
        self,
        what: str,
        party: bytes,
        now_s: float,
        handle: Callable[_Input, None],
        *given: _Input.args,
        **named: _Input.kwargs,
    ) -> bool:
        """Have input of a far party handled; return whether it was, without an error and without a quarantine.

        An error ends that input alone. It is a fault of ``what``, the local name that the party uses.

        Args:
            party: that is quarantined for this local name if it repeats errors; empty: several have their share.
        """
        try:
            with self.boundary.guard(what.encode() + party, now_s):
                handle(*given, **named)
        except RemoteError as error:
            detail = f"{error.detail or error}{f', from {Name(party).short}' if party else ''}"
            self.faults.report(what, _FAULTS.get(error.reason, Fault.MALFORMED), detail)
            for text in self.boundary.poll_tracebacks():
                log.error("input of a far party drew an error of this program; the proxy goes on\n%s", text)
            return False
        return True
