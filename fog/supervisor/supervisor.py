"""Reconciliation loop of clusters: desired state, observed state, and actions.

I/O. The supervisor carries no application data. It writes persistent state to the journal before it acts, and
observes all other state again after a restart. ``machine_actions`` acts; ``event_log`` and ``final_logs`` record
events.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, TypeAlias

from fog.bootstrap.domain_members import DomainMembers
from fog.bootstrap.members import metadata_of
from fog.cluster import CloudNode, ClusterPlan
from fog.machine import Machine, MachineState
from fog.providers.provider import Provider
from fog.site import Site
from fog.supervisor.autoscaling import Autoscaling
from fog.supervisor.core.reconcile import Timeouts, decide
from fog.supervisor.core.record import Record, update_record
from fog.supervisor.event_log import EventLog, changes
from fog.supervisor.gateway_uplinks import GatewayUplinks
from fog.supervisor.journal import Cluster, Journal
from fog.supervisor.machine_actions import MachineActions
from fog.supervisor.machine_credentials import MachineCredentials
from fog.supervisor.robot_access import RobotAccess
from fog.supervisor.usage_limits import UsageLimits
from fog.supervisor.watch import Watch
from gdp.errors import GdpError
from gdp.intervals import MINUTE_S, WATCH_S
from gdp.stores.keyring import load_public_key

Heard: TypeAlias = "Mapping[str, frozenset[str]]"  # service -> proxies that serve it, each 64 hex digits

_GRACE_POLLS: Final = 5  # polls in which a new machine may be missing
_GRACE_MIN_S: Final = 2.0
PATIENCE: Final = Timeouts()


class Supervisor:
    """Supervisor that keeps the clusters of a site in their desired state; ``StoreError``: the journal is unusable.

    Args:
        members: of the domain, which machines join.
        watch: reports which servers the overlay has; None: the overlay cannot be queried.
        software: returns the files by which a new machine fetches its software.
    """

    def __init__(
        self,
        *,
        site: Site,
        journal: Journal,
        members: DomainMembers,
        provider: Provider,
        command: Callable[[CloudNode], Sequence[str]],
        watch: Watch | None = None,
        patience: Timeouts = PATIENCE,
        software: Callable[[], Mapping[str, bytes]] = dict,
    ) -> None:
        self._site = site
        self._journal = journal
        self._watch = watch
        self._patience = patience
        self._grace_s = max(_GRACE_POLLS * provider.poll_s, _GRACE_MIN_S)
        self._woken = threading.Event()
        self._events = EventLog(journal)
        self._credentials = MachineCredentials(site, journal, self._events, members, boot_s=patience.boot_s)
        self._actions = MachineActions(
            site=site,
            journal=journal,
            events=self._events,
            credentials=self._credentials,
            provider=provider,
            command=command,
            wake=self._woken.set,
            software=software,
        )
        self._gateways = GatewayUplinks(journal, self._events, self._actions, patience)
        self._limits = UsageLimits(site, journal)
        self._scaling = Autoscaling(site, journal)
        self._robots = RobotAccess(site, watch)
        self._known: Heard | None = None  # what the overlay reported at the last reconciliation
        self._settled: set[str] = set()  # clusters that are down without leftovers
        self._owner_key = load_public_key(site.authority.owner_key).compressed

    @property
    def is_done(self) -> bool:
        """Return whether no cluster is wanted and none has leftovers."""
        return all(not each.is_up and each.plan.name in self._settled for each in self._journal.clusters())

    @property
    def running_actions(self) -> int:
        """Return the number of actions on machines that have not ended."""
        return self._actions.runner.running

    def use(self, provider: Provider) -> None:
        """Use another adapter of the same provider from now on, such as one with more regions."""
        self._actions.use(provider)

    def wake(self) -> None:
        """Make ``wait`` return at once; callable from any thread."""
        self._woken.set()

    def wait(self, beat: Callable[[], None] = lambda: None) -> None:
        """Wait until the next reconciliation is due, a machine has joined, or other replicas serve than before.

        Args:
            beat: called before each step of the wait.
        """
        left_s = self._actions.provider.poll_s
        beat()
        while left_s > 0 and not self._woken.wait(min(left_s, WATCH_S)) and not self._has_news():
            left_s -= WATCH_S
            beat()
        self._woken.clear()

    def _heard(self) -> Heard | None:
        return None if self._watch is None else self._watch.serving_proxies()

    def _has_news(self) -> bool:
        return self._credentials.has_reports() or self._heard() != self._known

    def close(self) -> None:
        """Wait for running actions and write their results; machines continue."""
        self._actions.runner.close()
        self._actions.collect_results(time.time())

    def reconcile(self) -> None:
        """Reconcile every cluster once."""
        self._known = self._heard()
        self._actions.collect_results(time.time())
        self._credentials.handle_reports(self._release_misused, time.time())
        for cluster in self._journal.clusters():
            name = cluster.plan.name
            if cluster.is_up:
                self._settled.discard(name)
            elif name in self._settled:
                continue
            try:
                self._reconcile_cluster(cluster)
                self._events.clear_trouble(name)
            except GdpError as error:
                self._events.add_trouble(name, str(error))

    def reconciled(self, begun_unix_s: float) -> None:
        """Write that clusters without trouble match the journal again after the start at ``begun_unix_s``."""
        now_s = time.time()
        for each in self._journal.clusters():
            name = each.plan.name
            if each.is_up and not self._events.has_trouble(name):
                took = f"{now_s - begun_unix_s:.2f} s after the supervisor's start"
                self._journal.write_event(now_s, name, "", "reconciled", took, since_unix_s=begun_unix_s)

    def _reconcile_cluster(self, cluster: Cluster) -> None:
        plan = cluster.plan
        is_new = cluster.is_up and not self._robots.has(plan)
        if is_new and not self._journal.machines(plan.name, gone=False):
            self._robots.grant(plan)  # its errors are reported before a machine costs money
        seen = {each.spec.name: each for each in self._actions.provider.describe(plan.name)}
        heard, now_s = self._heard(), time.time()
        services = _services(plan, self._owner_key)
        names = [] if self._site.watch is None else services
        records = self._observe(plan, names, seen, heard, now_s)
        excused = self._gateways.reconcile(plan.name, records, seen, now_s)
        self._actions.release_orphans(plan, records, seen, now_s)
        if cluster.is_up and (why := self._limits.reached(self._actions.provider.name, cluster, records, now_s)):
            self._journal.unwant(plan.name, why, now_s)
            self.wake()
            return
        wanted = self._scaling.machines(cluster, services, records, now_s) if cluster.is_up else ()
        liveness_known = not names or heard is not None
        patience = _patience(plan, self._patience)
        for action in decide(
            wanted,
            records,
            now_s,
            patience,
            liveness_known=liveness_known,
            excused=excused,
            pushed_unix_s=plan.pushed_unix_s,
        ):
            self._actions.apply(plan, action, records, now_s)
        if is_new and not self._robots.has(plan):
            self._robots.grant(plan)
        if not cluster.is_up and all(each.is_gone for each in records) and not self._actions.runner.is_busy(plan.name):
            self._settled.add(plan.name)
            self._limits.reset(plan.name)
            self._scaling.reset(plan.name)
            self._robots.remove(plan.name)

    def _observe(
        self, plan: ClusterPlan, names: Sequence[str], seen: Mapping[str, Machine], heard: Heard | None, now_s: float
    ) -> list[Record]:
        records = []
        for before in self._journal.machines(plan.name, gone=False):
            after, machine = before, seen.get(before.name)
            if before.id or not self._actions.runner.is_busy(plan.name, before.name):
                serves = (
                    None
                    if heard is None
                    else all(before.issued_credentials.proxy in heard.get(each, ()) for each in names)
                )
                if not names:  # topics have no calls: a machine that is up counts as serving
                    serves = machine is not None and machine.state is not MachineState.BOOTING
                after = update_record(before, machine, serves, now_s, grace_s=self._grace_s)
            for change in changes(before, after, machine, now_s):
                self._events.put(after, change.what, change.detail, now_s, change.since_unix_s)
            if after.is_gone and not before.is_gone:
                self._credentials.revoke(after, now_s)
            elif after != before:
                self._events.put(after, "", "", now_s)
            records.append(after)
        return records

    def _release_misused(self, plan: ClusterPlan, name: str, machine: str) -> None:
        """Release a machine whose token was misused, unless it is busy."""
        if not self._actions.runner.is_busy(plan.name, name):
            self._actions.release(plan, name, machine, is_lost=True)


def _patience(plan: ClusterPlan, patience: Timeouts) -> Timeouts:
    """Return the time limits of a cluster: a replica that is not ready has time to become so before it is replaced."""
    if not any("readiness" in each.served for each in plan.carried):
        return patience
    return replace(patience, unreachable_timeout_s=max(patience.unreachable_timeout_s, MINUTE_S))


def _services(plan: ClusterPlan, owner_key: bytes) -> list[str]:
    """Return the overlay names of services and actions."""
    return [metadata_of(each).name(owner_key).to_text() for each in plan.carried if each.kind != "topic"]
