"""Limits at which a cluster ends: its budget, and the time without a call.

I/O; reads the journal and the message counters of proxies. For machines on this host, the counters are those of the
machines' proxies. For other machines, they are the send counters of the robots' proxies; without them a cluster counts
as used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from fog.site import Site
from fog.supervisor.core.activity import Activity
from fog.supervisor.core.record import Record, cost_usd
from fog.supervisor.journal import Cluster, Journal
from fog.supervisor.proxy_metrics import received_by, sent_by
from gdp.intervals import POLL_S

_ON_THIS_HOST: Final = "local"


class UsageLimits:
    """Budget and idle time of the clusters of a site."""

    def __init__(self, site: Site, journal: Journal) -> None:
        self._site = site
        self._journal = journal
        self._activities: dict[str, Activity] = {}
        self._asked_s: dict[str, float] = {}  # when the counters were last read

    def reset(self, cluster: str) -> None:
        """Reset the state for the next cluster of this name."""
        self._activities.pop(cluster, None)

    def reached(self, provider: str, cluster: Cluster, records: Sequence[Record], now_s: float) -> str:
        """Return which limit of the cluster is reached; empty: none."""
        plan = cluster.plan
        if plan.budget_usd is not None:
            ours = (each for each in self._journal.machines(plan.name) if each.asked_unix_s >= cluster.begun_unix_s)
            spent = sum(cost_usd(each, now_s) for each in ours)
            if spent >= plan.budget_usd:
                return f"its budget is spent: {spent:.2f} of {plan.budget_usd:.2f} USD"
        if plan.idle_s is None or now_s - self._asked_s.get(plan.name, 0.0) < POLL_S:
            return ""
        self._asked_s[plan.name] = now_s
        if provider == _ON_THIS_HOST:
            counts = {each.name: received_by(each.issued_credentials.proxy) for each in records if each.is_serving}
        else:
            counts = {str(path): sent_by(path) for path in self._site.robots} or {"": None}
        idle_s = self._activities.setdefault(plan.name, Activity(now_s)).idle_s(counts, now_s)
        return f"not called for {idle_s:.0f} s" if idle_s >= plan.idle_s else ""
