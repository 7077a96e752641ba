"""Autoscaling of a site's clusters: load from the robots' proxies, prices from the machines there are.

I/O; reads the call counters of proxies, and writes an event for each change. ``fog.scaling`` decides.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fog.cluster import ClusterPlan, MachineRequest
from fog.scaling import Autoscaler, CallCounts
from fog.site import Site
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Cluster, Journal
from fog.supervisor.proxy_metrics import calls_of
from gdp.intervals import POLL_S


class Autoscaling:
    """Number of machines of each cluster that scales."""

    def __init__(self, site: Site, journal: Journal) -> None:
        self._site = site
        self._journal = journal
        self._scalers: dict[str, Autoscaler] = {}
        self._counts: dict[str, int] = {}
        self._asked_s: dict[str, float] = {}

    def reset(self, cluster: str) -> None:
        """Forget the state of a cluster that ended."""
        for kept in (self._scalers, self._counts, self._asked_s):
            kept.pop(cluster, None)

    def machines(
        self, cluster: Cluster, services: Collection[str], records: Sequence[Record], now_s: float
    ) -> tuple[MachineRequest, ...]:
        """Return the machines that a cluster is to have now.

        Args:
            services: overlay names of its services and actions, 64 hex digits each.
        """
        plan = cluster.plan
        if plan.scale is None:
            return plan.machines
        scaler = self._scalers.get(plan.name)
        if scaler is None or scaler.policy != plan.scale:
            scaler = self._scalers[plan.name] = Autoscaler(plan.scale)
            self._asked_s.pop(plan.name, None)
        there = sum(not each.is_gone and not each.is_outgoing for each in records)
        before = self._counts.get(plan.name) or there or len(plan.machines)
        if now_s - self._asked_s.get(plan.name, 0.0) >= POLL_S:
            self._asked_s[plan.name] = now_s
            scaler.observe(_total([calls_of(path, services) for path in self._site.robots]), now_s)
            self._counts[plan.name] = scaler.decide(before, _usd_per_hour(records), now_s)
        count = self._counts[plan.name]
        if count != before:
            self._tell(plan, before, count, scaler.reason, now_s)
        return plan.resized(count)

    def _tell(self, plan: ClusterPlan, before: int, count: int, reason: str, now_s: float) -> None:
        self._journal.write_event(now_s, plan.name, "", "scaled", f"{before} -> {count} machines: {reason}")


def _total(counts: Sequence[CallCounts | None]) -> CallCounts | None:
    """Return the sum; None: a proxy did not answer, or there is none."""
    known = [each for each in counts if each is not None]
    if not known or len(known) < len(counts):
        return None
    return CallCounts(sum(each.ended for each in known), sum(each.total_ms for each in known))


def _usd_per_hour(records: Sequence[Record]) -> float | None:
    """Return the mean price of the machines there are; None: there are none."""
    prices = [each.spec.offer.usd_per_hour for each in records if not each.is_gone and not each.is_outgoing]
    return sum(prices) / len(prices) if prices else None
