"""Actions on machines: create, drain and release, and their results.

I/O; calls the provider in threads. The journal is written before an action begins.
Each call of the provider has its own thread, so that a slow one does not block reconciliation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from fog.bootstrap.bundles import node_names
from fog.cluster import CloudNode, ClusterPlan, MachineRequest
from fog.hardware import Offer
from fog.latency.known import Latencies
from fog.machine import Machine, MachineSpec, MachineState
from fog.plan.choice import Choice
from fog.providers.provider import GatewayProvider, Provider
from fog.site import Site
from fog.supervisor.core.reconcile import Action, Drain, Launch
from fog.supervisor.core.record import IssuedCredentials, Outcome, Record
from fog.supervisor.event_log import EventLog
from fog.supervisor.final_logs import decode_logs, encode_logs
from fog.supervisor.journal import FINAL_LOGS, Journal
from fog.supervisor.machine_credentials import MachineCredentials
from fog.supervisor.placement import place, stopgap
from gdp.errors import GdpError, LocalError
from gdp.intervals import CACHE_S

ATTACH: Final = "attach uplink"
DETACH: Final = "detach uplink"
_MAX: Final = 8  # concurrent actions


@dataclass(frozen=True, slots=True)
class Done:
    """Finished action; ``result``: result of the provider; empty if there is none."""

    cluster: str
    machine: str
    what: str
    result: str
    error: GdpError | None


class ActionRunner:
    """Running actions, at most one per machine; ``wake``: called when an action has ended, from its thread."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._threads = ThreadPoolExecutor(_MAX, "act")
        self._futures: dict[tuple[str, str], tuple[str, Future[str | None]]] = {}

    def begin(self, cluster: str, machine: str, what: str, act: Callable[[], str | None]) -> None:
        """Begin an action on a machine that is not busy."""
        future = self._threads.submit(act)
        self._futures[cluster, machine] = what, future
        future.add_done_callback(lambda _: self._wake())

    def is_busy(self, cluster: str, machine: str = "") -> bool:
        """Return whether an action runs on a machine, or without a machine on any of the cluster."""
        return any(key == (cluster, machine) or (not machine and key[0] == cluster) for key in self._futures)

    @property
    def running(self) -> int:
        """Return the number of actions that have not ended."""
        return sum(not future.done() for _, future in list(self._futures.values()))

    def poll_done(self) -> list[Done]:
        """Return each finished action once. An error other than ``GdpError`` is raised."""
        over = [(key, what, future) for key, (what, future) in self._futures.items() if future.done()]
        found = []
        for key, what, future in over:
            del self._futures[key]
            error = future.exception()
            if error is not None and not isinstance(error, GdpError):
                raise error
            found.append(Done(*key, what, (future.result() or "") if error is None else "", error))
        return found

    def close(self) -> None:
        """Wait until all actions have ended."""
        self._threads.shutdown(wait=True)


class OfferCache:
    """A provider's offers by machine request."""

    def __init__(self, latencies: Latencies) -> None:
        self.latencies = latencies
        self._offers: dict[MachineRequest, tuple[float, list[Offer]]] = {}

    def clear(self) -> None:
        """Drop all offers."""
        self._offers.clear()

    def get(self, provider: Provider, wanted: MachineRequest, now_s: float) -> list[Offer]:
        """Return the provider's offers for a request, at most one minute old."""
        at_s, offers = self._offers.get(wanted, (0.0, []))
        if now_s - at_s >= CACHE_S or not offers:
            offers = provider.offers(wanted.hardware, spot=wanted.is_spot)
            self._offers[wanted] = now_s, offers
            self.latencies.refresh_in_background((each.region for each in offers), now_s)
        return offers


class MachineActions:
    """Executor of actions on a site's machines, which writes their results.

    Args:
        wake: called when an action has ended, from its thread.
        software: returns the files by which a new machine fetches its software.
    """

    def __init__(
        self,
        *,
        site: Site,
        journal: Journal,
        events: EventLog,
        credentials: MachineCredentials,
        provider: Provider,
        command: Callable[[CloudNode], Sequence[str]],
        wake: Callable[[], None],
        software: Callable[[], Mapping[str, bytes]] = dict,
    ) -> None:
        self.provider = provider
        self._site = site
        self._journal = journal
        self._events = events
        self._credentials = credentials
        self._command = command
        self._software = software
        self.runner = ActionRunner(wake)
        self._offers = OfferCache(site.latencies)
        self._swept: set[str] = set()  # machines without leftovers at the provider

    def use(self, provider: Provider) -> None:
        """Use another adapter of the same provider from now on."""
        self.provider = provider
        self._offers.clear()

    def apply(self, plan: ClusterPlan, action: Action, records: list[Record], now_s: float) -> None:
        """Begin a decided action on a machine; a busy machine keeps its action."""
        if isinstance(action, Launch):
            self._launch(plan, action, records, now_s)
            return
        (record,) = (each for each in records if each.name == action.name)
        if self.runner.is_busy(plan.name, record.name):
            return
        if isinstance(action, Drain):
            known = replace(record, drained_unix_s=now_s, reason=action.reason)
            self._events.put(known, "draining", action.reason, now_s)
            self.runner.begin(plan.name, record.name, "drain", partial(self.provider.drain, record.id))
        elif not record.id:
            self._events.put(
                record.ended(action.ending, action.reason, now_s), action.ending.value, action.reason, now_s
            )
        else:
            known = replace(record, released_unix_s=now_s, ending=action.ending, reason=action.reason)
            self._events.put(known, "leaving", action.reason, now_s)
            self._credentials.revoke(known, now_s)
            self.release(plan, record.name, record.id, is_lost=action.ending is not Outcome.RELEASED)

    def collect_results(self, now_s: float) -> None:
        """Write the results of finished actions into the journal."""
        for done in self.runner.poll_done():
            if done.what == "create":
                record = next(each for each in self._journal.machines(done.cluster) if each.name == done.machine)
                if done.error is not None:
                    reason = str(done.error)
                    self._events.put(record.ended(Outcome.FAILED, reason, now_s), "refused", reason, now_s)
                elif not record.is_gone:
                    self._events.put(replace(record, id=done.result), "", "", now_s)
            elif done.what in (ATTACH, DETACH) and done.error is not None:  # retried at the next reconciliation
                self._events.add_trouble(
                    done.cluster, f"{done.machine}: {done.what}: {done.error}", key=f"{done.cluster} uplink"
                )
            elif done.error is not None:
                self._journal.write_event(now_s, done.cluster, done.machine, "trouble", f"{done.what}: {done.error}")
            for program, lines in decode_logs(done.result) if done.what == "release" else ():
                self._journal.write_event(now_s, done.cluster, done.machine, FINAL_LOGS, program, lines=lines)

    def release(self, plan: ClusterPlan, name: str, machine: str, *, is_lost: bool) -> None:
        """Begin to release a machine; the final log lines of a lost machine are stored."""
        provider, programs = self.provider, node_names(plan)

        def act() -> str:
            words = encode_logs(provider, machine, programs) if is_lost else ""
            provider.terminate([machine])
            return words

        self.runner.begin(plan.name, name, "release", act)

    def release_orphans(
        self, plan: ClusterPlan, records: Sequence[Record], seen: Mapping[str, Machine], now_s: float
    ) -> None:
        """Release machines that the journal does not contain or records as gone, and leftovers of gone machines."""
        cluster = plan.name
        known = {each.name for each in records if not each.is_gone}
        lost = {each.name for each in records if each.is_gone and each.ending is not Outcome.RELEASED}
        for name, machine in seen.items():
            if name in known or machine.id in self._swept or self.runner.is_busy(cluster, name):
                continue
            if machine.state is MachineState.GONE:
                self._swept.add(machine.id)
            else:
                self._journal.write_event(now_s, cluster, name, "orphan", "no cluster wants it: returned")
            self.release(plan, name, machine.id, is_lost=name in lost)

    def _choose(self, plan: ClusterPlan, action: Launch, records: Sequence[Record], now_s: float) -> Choice | None:
        """Return the offer for a machine, and the reason; None: it is too early to ask again.

        Raises:
            GdpError: no offer fits, or the provider does not answer.
        """
        wanted = action.wanted
        falls_back = wanted.may_be_on_demand and not action.is_spot_only
        try:
            offers = self._offers.get(self.provider, wanted, now_s)
            latency_ms = self._offers.latencies.ms((each.region for each in offers), now_s)
            choice = place(wanted, offers, records, now_s, latency_ms)
        except LocalError:
            if not wanted.may_be_on_demand:
                raise
            choice = None  # no spot machine is offered now
        if choice is not None or not falls_back:
            return choice
        offers = self._offers.get(self.provider, wanted.on_demand(), now_s)
        latency_ms = self._offers.latencies.ms((each.region for each in offers), now_s)
        budget = None if plan.scale is None else plan.scale.budget_usd_per_h
        choice = stopgap(wanted, offers, records, now_s, latency_ms, budget_usd_per_h=budget)
        return None if choice is None else replace(choice, why=f"no spot machine is to be had: {choice.why}")

    def _launch(self, plan: ClusterPlan, action: Launch, records: list[Record], now_s: float) -> None:
        begun_s = self._journal.cluster(plan.name).begun_unix_s
        past = [each for each in self._journal.machines(plan.name) if each.is_gone and each.asked_unix_s >= begun_s]
        choice = self._choose(plan, action, [*past, *records], now_s)
        resting = f"{plan.name} rests"
        if choice is None and action.is_spot_only:
            return  # one on demand serves until a spot machine is to be had
        if choice is None:
            self._events.add_trouble(
                plan.name, "machines fail one after another: it is too early to ask again", key=resting
            )
            return
        self._events.clear_trouble(resting)
        offer = choice.offer
        spec = MachineSpec(plan.name, self._journal.next_machine(plan.name), offer)
        uplink = self._uplink_iface(offer.region)
        boot, until_unix_s = self._credentials.make_bundle(
            plan,
            spec.name,
            self._command,
            self._software(),
            now_s,
            uplink=uplink,
        )
        record = Record(spec, action.wanted, IssuedCredentials("", until_unix_s), now_s)
        records.append(record)
        detail = f"{offer.region} {offer.type_name}, {offer.usd_per_hour:.4f} USD an hour: {choice.why}"
        self._events.put(record, "requested", detail, now_s)
        self.runner.begin(plan.name, spec.name, "create", partial(self.provider.create, spec, boot))

    def _uplink_iface(self, region: str) -> str:
        provider = self.provider
        if isinstance(provider, GatewayProvider) and provider.replica_gateway(region):
            return provider.uplink_iface
        return ""
