"""Gateways of groups of machines: elections, and the resulting moves of uplinks.

I/O; writes the journal and calls the provider.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from fog.machine import Machine, MachineState
from fog.providers.provider import GatewayProvider
from fog.supervisor.core.gateway_election import elect, excused_names
from fog.supervisor.core.reconcile import Timeouts
from fog.supervisor.core.record import Record
from fog.supervisor.event_log import EventLog
from fog.supervisor.journal import Journal
from fog.supervisor.machine_actions import ATTACH, DETACH, MachineActions


class GatewayUplinks:
    """Controller that maintains one gateway in each group of machines."""

    def __init__(self, journal: Journal, events: EventLog, actions: MachineActions, patience: Timeouts) -> None:
        self._journal = journal
        self._events = events
        self._actions = actions
        self._patience = patience
        self._uplinks: set[str] = set()  # machines whose uplink was checked since this supervisor started

    def reconcile(
        self, cluster: str, records: list[Record], seen: Mapping[str, Machine], now_s: float
    ) -> frozenset[str]:
        """Elect gateways among machines, and make the provider move their uplinks.

        Args:
            records: of the cluster; records whose role changes are replaced.

        Returns:
            Names of machines that may be unreachable because of their gateway, and are kept.
        """
        provider = self._actions.provider
        if not isinstance(provider, GatewayProvider):
            return frozenset()
        groups: dict[str, list[Record]] = {}
        others = [each.plan.name for each in self._journal.clusters() if each.plan.name != cluster]
        everyone = [*records, *(each for other in others for each in self._journal.machines(other, gone=False))]
        for each in everyone:
            if label := provider.replica_gateway(each.spec.offer.region):
                groups.setdefault(label, []).append(each)
        excused: set[str] = set()
        for label, group in groups.items():
            if (election := elect(group, label, now_s, self._patience)) is not None:
                new = replace(election.new, gateway=label, gateway_unix_s=now_s)
                old = election.old and replace(election.old, gateway="", gateway_unix_s=now_s)
                for changed in (new, *([old] if old else [])):
                    group[:] = [changed if each.spec == changed.spec else each for each in group]
                    records[:] = [changed if each.spec == changed.spec else each for each in records]
                if old is not None:
                    self._events.put(old, "", "", now_s)
                self._events.put(new, "gateway", f"of {label}: {election.reason}", now_s)
            own = [each for each in group if each.spec.cluster == cluster]
            excused |= excused_names(group, label, now_s, self._patience) & {each.name for each in own}
        for record in records:
            if record.id and record.name in seen and not self._actions.runner.is_busy(cluster, record.name):
                self._reconcile_uplink(provider, record, seen[record.name])
        return frozenset(excused)

    def _reconcile_uplink(self, provider: GatewayProvider, record: Record, seen: Machine) -> None:
        """Begin to move an uplink if the provider's state differs; an outgoing machine keeps its uplink."""
        if record.is_gone or seen.state is MachineState.GONE:
            return
        cluster, name = record.spec.cluster, record.name
        if record.gateway and not (seen.is_gateway and record.id in self._uplinks):
            self._uplinks.add(record.id)
            self._actions.runner.begin(cluster, name, ATTACH, partial(provider.attach_uplink, record.id))
        elif seen.is_gateway and not record.gateway and not record.is_outgoing:
            self._actions.runner.begin(cluster, name, DETACH, partial(provider.detach_uplink, record.id))
