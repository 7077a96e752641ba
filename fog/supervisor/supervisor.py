"""The supervisor: looks, learns, decides, acts, again and again. It carries no application data.

Place: shell. What it must not forget is in the journal before it acts; what it forgets it sees again.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, TypeAlias

from fog.cluster import CloudNode, ClusterPlan, Wanted
from fog.enrolment.boots import PROXY, machine_boot, machine_seats, node_names
from fog.enrolment.members import metadata_of
from fog.enrolment.papers import Papers
from fog.enrolment.revoking import take_back
from fog.enrolment.robot_side import forget_rules, introduce, reload
from fog.enrolment.tickets import News, Report, Tickets
from fog.machine import Machine, MachineSpec, MachineState
from fog.offer import Offer
from fog.providers.provider import GatewayProvider, Provider
from fog.site import Site
from fog.supervisor.activity import Activity, requests_in
from fog.supervisor.acts import Acts
from fog.supervisor.decide import Action, Drain, Launch, Patience, decide
from fog.supervisor.gateway_election import elect, is_settling
from fog.supervisor.journal import LAST_WORDS, Cluster, Journal
from fog.supervisor.last_words import keep, kept
from fog.supervisor.place import place
from fog.supervisor.record import Ending, Record, cost_usd, learn
from fog.supervisor.robot_calls import sent_by
from fog.supervisor.story import changes
from gdp.errors import GdpError, LocalError
from gdp.stores.issue import DAY_S
from gdp.stores.keyring import load_domain, load_public_key
from gdp.trust.enrolment import TOKEN_BYTES, Ticket

__all__ = ["Heard", "Supervisor"]

log = logging.getLogger(__name__)

Heard: TypeAlias = "Mapping[str, frozenset[str]]"  # service -> proxies that serve it, each 64 hex digits

_ACTIVITY_S: Final = 2.0  # between questions about it
_OFFERS_S: Final = 60.0  # a price list holds
_GRACE_POLLS: Final = 5  # looks in which a new machine may be missing
_GRACE_MIN_S: Final = 2.0
_LOG_LINES: Final = 20
_LATE_LOGS: Final = {"aws"}  # a console as it was minutes ago, or since the last start
_ROBOT_DAYS: Final = 365.0
_ATTACH, _DETACH = "attach uplink", "detach uplink"
PATIENCE: Final = Patience()


class Supervisor:
    """Keeps the clusters of a site as they are wanted.

    Args:
        tickets: with which machines enrol.
        command: how a node is started on a machine.
        heard: what the overlay says of who serves; None: it cannot be asked.
        on_names: called when the watch is to know more names.
    """

    def __init__(
        self,
        site: Site,
        journal: Journal,
        tickets: Tickets,
        provider: Provider,
        command: Callable[[CloudNode], Sequence[str]],
        heard: Callable[[], Heard | None],
        on_names: Callable[[], None] = lambda: None,
        patience: Patience = PATIENCE,
    ) -> None:
        self._site = site
        self._journal = journal
        self._tickets = tickets
        self._provider = provider
        self._command = command
        self._heard = heard
        self._on_names = on_names
        self._patience = patience
        self._grace_s = max(_GRACE_POLLS * provider.poll_s, _GRACE_MIN_S)
        self._woken = threading.Event()
        self._acts = Acts(self._woken.set)
        self._latencies = site.latencies
        self._offers: dict[Wanted, tuple[float, list[Offer]]] = {}
        self._activities: dict[str, Activity] = {}
        self._asked_s: dict[str, float] = {}  # when activity was last asked about
        self._plans: dict[str, ClusterPlan] = {}  # those that the robot's side knows
        self._settled: set[str] = set()  # down, and nothing is left of them
        self._swept: set[str] = set()  # machines of which nothing is left
        self._troubles: dict[str, str] = {}  # told once
        self._uplinks: set[str] = set()  # machines whose uplink was seen to, since this supervisor began
        self._owner_key = load_public_key(site.authority.owner_key).compressed

    @property
    def is_done(self) -> bool:
        """Return whether nothing is wanted and nothing is left."""
        return all(not each.is_up and each.plan.name in self._settled for each in self._journal.clusters())

    def use(self, provider: Provider) -> None:
        """Ask another adapter of the same provider from now on, such as one that offers more regions."""
        self._provider = provider
        self._offers.clear()

    def wake(self) -> None:
        """Have ``wait`` return at once; from any thread."""
        self._woken.set()

    def wait(self) -> None:
        """Return when it is time for the next look."""
        self._woken.wait(self._provider.poll_s)
        self._woken.clear()

    def close(self) -> None:
        """Wait for what is being done, and write it down; machines stay."""
        self._acts.close()
        self._harvest(time.time())

    def look(self) -> None:
        """Look at every cluster once, and do what is to be done.

        Raises:
            StoreError: the journal cannot be read or written.
        """
        self._harvest(time.time())
        self._take_news(time.time())
        for cluster in self._journal.clusters():
            name = cluster.plan.name
            if cluster.is_up:
                self._settled.discard(name)
            elif name in self._settled:
                continue
            try:
                self._tend(cluster)
                self._troubles.pop(name, None)
            except GdpError as error:
                self._trouble(name, str(error))

    def reconciled(self, begun_unix_s: float) -> None:
        """Write that all is as the journal says again, after the start at ``begun_unix_s``; not of what is in trouble.

        Raises:
            StoreError: the journal cannot be written.
        """
        now_s = time.time()
        for each in self._journal.clusters():
            name = each.plan.name
            if each.is_up and name not in self._troubles:
                told = f"{now_s - begun_unix_s:.2f} s after the supervisor's start"
                self._journal.tell(now_s, name, "", "reconciled", told, since_unix_s=begun_unix_s)

    def _tend(self, cluster: Cluster) -> None:
        plan = cluster.plan
        is_new = cluster.is_up and self._plans.get(plan.name) != plan
        if is_new and not self._journal.machines(plan.name, gone=False):
            self._introduce(plan)  # what is wrong there is told before a machine costs something
        seen = {each.spec.name: each for each in self._provider.describe(plan.name)}
        heard, now_s = self._heard(), time.time()
        names = [] if self._site.watch is None else _services(plan, self._owner_key)
        records = self._learn(plan, names, seen, heard, now_s)
        excused = self._tend_gateways(plan.name, records, seen, now_s)
        self._end_orphans(plan, records, seen, now_s)
        if cluster.is_up and (why := self._limit(cluster, records, now_s)):
            self._journal.unwant(plan.name, why, now_s)
            self.wake()
            return
        wanted = plan.machines if cluster.is_up else ()
        told = not names or heard is not None
        for action in decide(wanted, records, now_s, self._patience, told=told, excused=excused):
            self._do(plan, action, records, now_s)
        if is_new and self._plans.get(plan.name) != plan:
            self._introduce(plan)
        if not cluster.is_up and all(each.is_gone for each in records) and not self._acts.is_busy(plan.name):
            self._forget(plan.name)

    def _learn(
        self,
        plan: ClusterPlan,
        names: Sequence[str],
        seen: Mapping[str, Machine],
        heard: Heard | None,
        now_s: float,
    ) -> list[Record]:
        records = []
        for before in self._journal.machines(plan.name, gone=False):
            after, machine = before, seen.get(before.name)
            if before.id or not self._acts.is_busy(plan.name, before.name):
                serves = None if heard is None else all(before.papers.proxy in heard.get(each, ()) for each in names)
                if not names:  # of topics nobody asks: a machine that is up does what it is for
                    serves = machine is not None and machine.state is not MachineState.BOOTING
                after = learn(before, machine, serves, now_s, grace_s=self._grace_s)
            for change in changes(before, after, machine, now_s):
                self._put(after, change.what, change.detail, now_s, change.since_unix_s)
            if after.is_gone and not before.is_gone:
                self._revoke(after, now_s)
            elif after != before:
                self._put(after, "", "", now_s)
            records.append(after)
        return records

    def _tend_gateways(
        self, cluster: str, records: list[Record], seen: Mapping[str, Machine], now_s: float
    ) -> frozenset[str]:
        """Elect gateways among machines, and have the provider move their uplinks.

        Args:
            records: of the cluster; those whose role changes are replaced.

        Returns the machines that may be silent because their gateway is new.
        """
        provider = self._provider
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
                    self._put(old, "", "", now_s)
                self._put(new, "gateway", f"of {label}: {election.reason}", now_s)
            if is_settling(group, label, now_s, self._patience):
                excused.update(each.name for each in group if each.spec.cluster == cluster)
        for record in records:
            if record.id and record.name in seen and not self._acts.is_busy(cluster, record.name):
                self._tend_uplink(provider, record, seen[record.name])
        return frozenset(excused)

    def _tend_uplink(self, provider: GatewayProvider, record: Record, seen: Machine) -> None:
        """Begin to move an uplink where the provider has it otherwise; a machine on its way out keeps its own."""
        if record.is_gone or seen.state is MachineState.GONE:
            return
        cluster, name = record.spec.cluster, record.name
        if record.gateway and not (seen.is_gateway and record.id in self._uplinks):
            self._uplinks.add(record.id)
            self._acts.begin(cluster, name, _ATTACH, partial(provider.attach_uplink, record.id))
        elif seen.is_gateway and not record.gateway and not record.is_outgoing:
            self._acts.begin(cluster, name, _DETACH, partial(provider.detach_uplink, record.id))

    def _do(self, plan: ClusterPlan, action: Action, records: list[Record], now_s: float) -> None:
        if isinstance(action, Launch):
            self._launch(plan, action.wanted, records, now_s)
            return
        (record,) = (each for each in records if each.name == action.name)
        if self._acts.is_busy(plan.name, record.name):
            return
        if isinstance(action, Drain):
            known = replace(record, drained_unix_s=now_s, reason=action.reason)
            self._put(known, "draining", action.reason, now_s)
            self._acts.begin(plan.name, record.name, "drain", partial(self._provider.drain, record.id))
        elif not record.id:
            self._put(record.ended(action.ending, action.reason, now_s), action.ending.value, action.reason, now_s)
        else:
            known = replace(record, released_unix_s=now_s, ending=action.ending, reason=action.reason)
            self._put(known, "leaving", action.reason, now_s)
            self._revoke(known, now_s)
            self._release(plan, record.name, record.id, is_lost=action.ending is not Ending.RELEASED)

    def _release(self, plan: ClusterPlan, name: str, machine: str, *, is_lost: bool) -> None:
        """Begin to give a machine back; of one that was lost, what its programs said last is kept."""
        provider, programs = self._provider, node_names(plan)

        def act() -> str:
            words = keep(provider, machine, programs) if is_lost else ""
            provider.terminate([machine])
            return words

        self._acts.begin(plan.name, name, "release", act)

    def _launch(self, plan: ClusterPlan, wanted: Wanted, records: list[Record], now_s: float) -> None:
        begun_s = self._journal.cluster(plan.name).begun_unix_s
        past = [each for each in self._journal.machines(plan.name) if each.is_gone and each.asked_unix_s >= begun_s]
        offers = self._offered(wanted, now_s)
        latency_ms = self._latencies.ms((each.region for each in offers), now_s)
        choice = place(wanted, offers, [*past, *records], now_s, latency_ms)
        resting = f"{plan.name} rests"
        if choice is None:
            self._trouble(plan.name, "machines fail one after another: it is too early to ask again", key=resting)
            return
        self._troubles.pop(resting, None)
        offer = choice.offer
        spec = MachineSpec(plan.name, self._journal.next_machine(plan.name), offer)
        uplink = self._uplink_iface(offer.region)
        ticket, until_unix_s = self._ticket(plan, spec.name, now_s, is_gateway=bool(uplink))
        boot = machine_boot(
            self._site.authority,
            plan,
            spec.name,
            self._command,
            ticket,
            iface=self._site.machine_iface,
            lease_s=self._site.lease_s,
            shares_host=self._provider.name == "local",
            uplink=uplink,
        )
        record = Record(spec, wanted, Papers("", until_unix_s), now_s)
        records.append(record)
        detail = f"{offer.region} {offer.type_name}, {offer.usd_per_hour:.4f} USD an hour: {choice.why}"
        self._put(record, "asked", detail, now_s)
        self._acts.begin(plan.name, spec.name, "create", partial(self._provider.create, spec, boot))

    def _ticket(self, plan: ClusterPlan, name: str, now_s: float, *, is_gateway: bool) -> tuple[Ticket, float]:
        """Return a new machine's ticket, and until when what is issued for it will hold.

        Args:
            is_gateway: the machine may become the gateway of its group.

        Raises:
            LocalError: no domain there, or its root has run out.
        """
        root = load_domain(self._site.authority.domain).root
        until_s = min(now_s + self._site.papers_days * DAY_S, float(root.validity.not_after_unix_s))
        if until_s <= now_s:
            raise LocalError("the root of the domain has run out")
        ticket = self._tickets.issue(
            plan.name,
            name,
            machine_seats(plan, name, is_gateway=is_gateway),
            secrets.token_bytes(TOKEN_BYTES),
            addresses=[self._site.enrolment_url],
            unix_s=now_s,
            expires_unix_s=now_s + self._patience.boot_s,
            until_unix_s=until_s,
        )
        return ticket, until_s

    def _take_news(self, now_s: float) -> None:
        """Learn which machines enrolled, and let go of those whose token somebody else knows."""
        for news in self._tickets.news():
            record = next((each for each in self._journal.machines(news.cluster) if each.name == news.machine), None)
            if record is not None:
                if news.papers is not None:
                    record = replace(record, papers=news.papers)
                if news.report is Report.ENROLLED:
                    self._put(record, "enrolled", news.detail, now_s)
                    if record.is_gone or record.is_released:
                        self._revoke(record, now_s)
                else:
                    self._let_go_misused(record, news, now_s)
            self._tickets.taken(news)

    def _let_go_misused(self, record: Record, news: News, now_s: float) -> None:
        log.error("token misused cluster=%s machine=%s: %s", news.cluster, news.machine, news.detail)
        if not self._site.enrolment.revoke_misused or record.is_gone:
            self._put(record, "alarm", news.detail, now_s)
            return
        ending = Ending.FAILED if record.served_unix_s is None else Ending.TAKEN
        known = replace(record, released_unix_s=now_s, ending=ending, reason="its enrolment token was misused")
        self._put(known, "alarm", f"{news.detail}; it is revoked and replaced", now_s)
        self._revoke(known, now_s)
        if record.id and not self._acts.is_busy(news.cluster, news.machine):
            plan = self._journal.cluster(news.cluster).plan
            self._release(plan, news.machine, record.id, is_lost=True)

    def _uplink_iface(self, region: str) -> str:
        provider = self._provider
        if isinstance(provider, GatewayProvider) and provider.replica_gateway(region):
            return provider.uplink_iface
        return ""

    def _offered(self, wanted: Wanted, now_s: float) -> list[Offer]:
        at_s, offers = self._offers.get(wanted, (0.0, []))
        if now_s - at_s >= _OFFERS_S or not offers:
            offers = self._provider.offers(wanted.hardware, spot=wanted.is_spot)
            self._offers[wanted] = now_s, offers
            self._latencies.refresh_in_background((each.region for each in offers), now_s)
        return offers

    def _harvest(self, now_s: float) -> None:
        """Write down what became of acts."""
        for done in self._acts.take_done():
            if done.what == "create":
                record = next(each for each in self._journal.machines(done.cluster) if each.name == done.machine)
                if done.error is not None:
                    reason = str(done.error)
                    self._put(record.ended(Ending.FAILED, reason, now_s), "refused", reason, now_s)
                elif not record.is_gone:
                    self._put(replace(record, id=done.result), "", "", now_s)
            elif done.what in (_ATTACH, _DETACH) and done.error is not None:  # tried again at the next look
                self._trouble(done.cluster, f"{done.machine}: {done.what}: {done.error}", key=f"{done.cluster} uplink")
            elif done.error is not None:
                self._journal.tell(now_s, done.cluster, done.machine, "trouble", f"{done.what}: {done.error}")
            for program, lines in kept(done.result) if done.what == "release" else ():
                self._journal.tell(now_s, done.cluster, done.machine, LAST_WORDS, program, lines=lines)

    def _end_orphans(
        self, plan: ClusterPlan, records: Sequence[Record], seen: Mapping[str, Machine], now_s: float
    ) -> None:
        """Give back what the journal does not know, or thought gone; and what is left of a machine that is gone."""
        cluster = plan.name
        known = {each.name for each in records if not each.is_gone}
        lost = {each.name for each in records if each.is_gone and each.ending is not Ending.RELEASED}
        for name, machine in seen.items():
            if name in known or machine.id in self._swept or self._acts.is_busy(cluster, name):
                continue
            if machine.state is MachineState.GONE:
                self._swept.add(machine.id)
            else:
                self._journal.tell(now_s, cluster, name, "orphan", "nobody wants it: given back")
            self._release(plan, name, machine.id, is_lost=name in lost)

    def _limit(self, cluster: Cluster, records: Sequence[Record], now_s: float) -> str:
        """Return which limit of the cluster is reached; empty: none."""
        plan = cluster.plan
        if plan.budget_usd is not None:
            ours = (each for each in self._journal.machines(plan.name) if each.asked_unix_s >= cluster.begun_unix_s)
            spent = sum(cost_usd(each, now_s) for each in ours)
            if spent >= plan.budget_usd:
                return f"its budget is spent: {spent:.2f} of {plan.budget_usd:.2f} USD"
        if plan.idle_s is None or now_s - self._asked_s.get(plan.name, 0.0) < _ACTIVITY_S:
            return ""
        self._asked_s[plan.name] = now_s
        if self._provider.name in _LATE_LOGS:
            counts = {str(path): sent_by(path) for path in self._site.robots} or {"": None}
        else:
            counts = {each.name: self._requests(each) for each in records if each.is_serving}
        idle_s = self._activities.setdefault(plan.name, Activity(now_s)).idle_s(counts, now_s)
        return f"not called for {idle_s:.0f} s" if idle_s >= plan.idle_s else ""

    def _requests(self, record: Record) -> int | None:
        try:
            return requests_in(self._provider.log(record.id, PROXY, _LOG_LINES))
        except GdpError:
            return None  # it may have ended this very moment; the next look knows

    def _introduce(self, plan: ClusterPlan) -> None:
        """Tell the robot's side, and the watch, what the cluster serves."""
        authority = self._site.authority
        for path in self._site.robots:
            introduce(path, authority, plan.name, plan.carried, days=_ROBOT_DAYS)
            reload(path)
        if self._site.watch is not None:
            keys, _ = self._site.watch
            services = [each for each in plan.carried if each.kind != "topic"]
            authority.let(keys, keys / "delegations", services, days=_ROBOT_DAYS)
            self._on_names()
        self._plans[plan.name] = plan

    def _forget(self, name: str) -> None:
        """Take from the robot's side what a cluster served that is no more; others may serve the same names."""
        self._settled.add(name)
        self._plans.pop(name, None)
        self._activities.pop(name, None)
        for path in self._site.robots:
            if forget_rules(path, name):
                for plan in self._plans.values():
                    introduce(path, self._site.authority, plan.name, plan.carried, days=_ROBOT_DAYS)
                reload(path)

    def _revoke(self, record: Record, now_s: float) -> None:
        self._tickets.take_back(record.spec.cluster, record.name)
        if self._site.revocations is None:
            return
        folder, switch = self._site.revocations
        papers = record.papers
        domain = self._site.authority.domain
        try:
            if take_back(domain, folder, papers.fingerprints, until_unix_s=papers.until_unix_s, unix_s=now_s):
                reload(switch)
        except LocalError as error:
            self._journal.tell(now_s, record.spec.cluster, record.name, "trouble", f"not revoked: {error}")

    def _put(self, record: Record, what: str, detail: str, now_s: float, since_unix_s: float | None = None) -> None:
        self._journal.put(record, now_s, what, detail, since_unix_s)
        if what:
            log.info("machine %s cluster=%s machine=%s %s", what, record.spec.cluster, record.name, detail)

    def _trouble(self, cluster: str, reason: str, *, key: str = "") -> None:
        """Tell what is wrong with a cluster, once."""
        if self._troubles.get(key or cluster) != reason:
            self._troubles[key or cluster] = reason
            self._journal.tell(time.time(), cluster, "", "trouble", reason)
            log.warning("trouble cluster=%s reason=%s", cluster, reason)


def _services(plan: ClusterPlan, owner_key: bytes) -> list[str]:
    """Return the overlay's names of what can be called."""
    return [metadata_of(each).name(owner_key).to_text() for each in plan.carried if each.kind != "topic"]
