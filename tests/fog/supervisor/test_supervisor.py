"""Supervisor with a provider in memory: it observes again what it must not forget."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from fog.bootstrap.domain_members import DomainMembers
from fog.cluster import CloudNode, ClusterPlan, ExportedInterface
from fog.hardware import Hardware, Offer
from fog.machine import Machine, MachineBundle, MachineSpec, MachineState
from fog.site import Site, open_site
from fog.supervisor.journal import Journal
from fog.supervisor.supervisor import Supervisor
from gdp.errors import StoreError
from lab.process import until
from tests.fog.supervisor.machines import OFFERS, SPOT

PLAN = ClusterPlan("c", (CloudNode("p", "e"),), (SPOT, SPOT), (ExportedInterface("topic", "/t", "std_msgs/msg/Empty"),))


class Memory:
    """Provider whose machines are up at once."""

    name = "memory"
    poll_s = 0.01

    def __init__(self) -> None:
        self.said: dict[str, str] = {}
        self.machines: dict[str, Machine] = {}
        self.refuses = 0  # number of next calls that fail
        self.spent: list[str] = []

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        return OFFERS

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        if self.refuses:
            self.refuses -= 1
            raise StoreError("no capacity")
        self.machines[spec.name] = Machine(f"id-{spec.name}", spec, MachineState.RUNNING, time.time())
        return f"id-{spec.name}"

    def describe(self, cluster: str) -> list[Machine]:
        return list(self.machines.values())

    def terminate(self, ids: Sequence[str]) -> None:
        self.machines = {name: each for name, each in self.machines.items() if each.id not in ids}
        self.spent += ids

    def drain(self, machine: str) -> None:
        self.terminate([machine])

    def log(self, machine: str, program: str, lines: int) -> str:
        return self.said.get(program, "")

    def shell(self, machine: str) -> list[str]:
        return []

    def close(self) -> None:
        pass


class Grouped(Memory):
    """Provider whose machines are one group, one of which is the gateway."""

    uplink_iface = "up"

    def __init__(self) -> None:
        super().__init__()
        self.ports: dict[str, list[object]] = {}
        self.fails = 0  # number of next calls that fail

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        self.ports[spec.name] = yaml.safe_load(boot.files["switch.yaml"])["ports"]
        return super().create(spec, boot)

    def replica_gateway(self, region: str) -> str:
        return "edge"

    def attach_uplink(self, machine: str) -> None:
        if self.fails:
            self.fails -= 1
            raise StoreError("not now")
        self._set(machine, is_gateway=True)

    def detach_uplink(self, machine: str) -> None:
        self._set(machine, is_gateway=False)

    def gateways(self) -> list[str]:
        return [name for name, each in self.machines.items() if each.is_gateway]

    def _set(self, machine: str, *, is_gateway: bool) -> None:
        name = machine.removeprefix("id-")
        self.machines[name] = replace(self.machines[name], is_gateway=is_gateway)


def elected(journal: Journal) -> list[str]:
    return [each.name for each in journal.machines("c", gone=False) if each.gateway == "edge"]


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return open_site(None, tmp_path / "state")


@pytest.fixture
def journal(site: Site) -> Iterator[Journal]:
    journal = Journal(site.journal)
    yield journal
    journal.close()


def supervisor(site: Site, journal: Journal, provider: Memory) -> Supervisor:
    return Supervisor(
        site=site,
        journal=journal,
        members=DomainMembers(site.domain_files),
        provider=provider,
        command=lambda _: ("run",),
    )


def work(each: Supervisor, is_met: Callable[[], object]) -> None:
    def turn() -> None:
        """Let the supervisor work."""
        each.reconcile()
        each.wait()

    until(is_met, patience_s=20.0, meanwhile=turn)


def serving(journal: Journal) -> list[str]:
    return [each.name for each in journal.machines("c", gone=False) if each.is_serving]


def test_what_is_wanted_is_launched_and_what_is_not_is_given_back(site: Site, journal: Journal) -> None:
    provider = Memory()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2)
    journal.unwant("c", "test", time.time())
    work(ours, lambda: ours.is_done)
    assert provider.machines == {}
    ours.close()


def test_a_machine_whose_supervisor_died_before_noting_its_id_is_found_again(site: Site, journal: Journal) -> None:
    provider = Memory()
    first = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(first, lambda: len(serving(journal)) == 2)
    first.close()
    record = journal.machines("c")[0]
    journal.put(replace(record, id="", up_unix_s=None, served_unix_s=None), time.time())
    second = supervisor(site, journal, provider)
    work(second, lambda: len(serving(journal)) == 2)
    second.close()
    assert journal.machines("c")[0].id == record.id
    assert len(journal.machines("c")) == 2


def test_a_machine_that_no_journal_knows_is_given_back(site: Site, journal: Journal) -> None:
    provider = Memory()
    provider.create(MachineSpec("c", "m99", OFFERS[0]), MachineBundle({}, ()))
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2 and "m99" not in provider.machines)
    ours.close()


def test_a_lost_machine_is_replaced_and_reported(site: Site, journal: Journal) -> None:
    provider = Memory()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2)
    del provider.machines["m1"]
    work(ours, lambda: serving(journal) == ["m2", "m3"])
    ours.close()
    assert [each.what for each in journal.events("c") if each.machine == "m1"][-1] == "preempted"


def test_a_refusal_is_reported_and_tried_elsewhere(site: Site, journal: Journal) -> None:
    provider = Memory()
    provider.refuses = 1
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2)
    ours.close()
    assert next(each for each in journal.events("c") if each.what == "refused").detail == "no capacity"


def test_a_spent_budget_ends_a_cluster(site: Site, journal: Journal) -> None:
    ours = supervisor(site, journal, Memory())
    journal.put_cluster(replace(PLAN, budget_usd=1e-6), time.time())
    work(ours, lambda: not journal.cluster("c").is_up and ours.is_done)
    ours.close()
    assert "budget" in journal.cluster("c").why


def test_a_cluster_without_calls_is_ended_and_one_that_is_called_is_not(
    site: Site, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    provider, now_s = Memory(), time.time()
    provider.name = "local"
    received = [1]
    monkeypatch.setattr("fog.supervisor.usage_limits.received_by", lambda proxy: received[-1])
    ours = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, idle_s=60.0), now_s)
    work(ours, lambda: len(serving(journal)) == 2)
    for later_s, count in ((40.0, 2), (80.0, 3), (120.0, 3)):
        received.append(count)
        monkeypatch.setattr(time, "time", lambda at_s=now_s + later_s: at_s)
        ours.reconcile()
        assert journal.cluster("c").is_up
    monkeypatch.setattr(time, "time", lambda: now_s + 145.0)
    work(ours, lambda: ours.is_done)
    ours.close()
    assert journal.cluster("c").why == "not called for 65 s"
    assert provider.machines == {}


def test_what_the_programs_of_a_lost_machine_said_last_is_kept(site: Site, journal: Journal) -> None:
    provider = Memory()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2)
    provider.said = {"node": "one\nout of memory\n"}
    lost = provider.machines["m1"]
    provider.machines["m1"] = replace(lost, state=MachineState.GONE, reason="killed", since_unix_s=7.0)
    work(ours, lambda: journal.stored_logs("c", "m1"))
    ours.close()
    assert journal.stored_logs("c", "m1") == {"node": "one\nout of memory"}
    (taken,) = (each for each in journal.events("c") if each.what == "preempted")
    assert (taken.detail, taken.since_unix_s) == ("killed", 7.0)


def test_what_a_machine_that_was_given_back_said_is_not_kept(site: Site, journal: Journal) -> None:
    provider = Memory()
    provider.said = {"node": "word"}
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2)
    journal.unwant("c", "test", time.time())
    work(ours, lambda: ours.is_done)
    ours.close()
    assert journal.stored_logs("c", "m1") == {}


def test_after_its_start_a_supervisor_says_when_all_was_looked_at(site: Site, journal: Journal) -> None:
    ours = supervisor(site, journal, Memory())
    journal.put_cluster(PLAN, time.time())
    ours.reconcile()
    begun_s = time.time() - 1.5
    ours.reconciled(begun_s)
    ours.close()
    reported = journal.events("c")[-1]
    assert (reported.what, reported.since_unix_s, reported.detail[:3]) == ("reconciled", begun_s, "1.5")


def test_a_region_that_is_nearer_is_taken_and_said(site: Site, journal: Journal) -> None:
    latency_ms = {"east": 90.0, "west": 12.0, "south": 80.0}
    near = replace(site, config=site.config.model_copy(update={"latency_ms": latency_ms}))
    ours = supervisor(near, journal, Memory())
    journal.put_cluster(replace(PLAN, machines=(SPOT,)), time.time())
    work(ours, lambda: len(serving(journal)) == 1)
    ours.close()
    (asked,) = (each for each in journal.events("c") if each.what == "requested")
    assert asked.detail.startswith("west")
    assert "12 ms away" in asked.detail


@pytest.mark.parametrize(("sent", "is_up"), [(7, False), (None, True)])
def test_of_machines_elsewhere_the_robots_counters_decide_and_without_them_a_cluster_counts_as_used(
    site: Site, journal: Journal, monkeypatch: pytest.MonkeyPatch, sent: int | None, is_up: bool
) -> None:
    provider, now_s = Memory(), time.time()
    provider.name = "aws"
    monkeypatch.setattr("fog.supervisor.usage_limits.sent_by", lambda path: sent)
    ours = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, idle_s=60.0), now_s)
    work(ours, lambda: len(serving(journal)) == 2)
    for later_s in (30.0, 60.0, 100.0):
        monkeypatch.setattr(time, "time", lambda at_s=now_s + later_s: at_s)
        ours.reconcile()
    ours.close()
    assert journal.cluster("c").is_up is is_up


def test_one_machine_becomes_the_gateway_and_every_machine_can(site: Site, journal: Journal) -> None:
    provider = Grouped()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2 and provider.gateways() == elected(journal) != [])
    ours.close()
    assert len(elected(journal)) == 1
    uplink = {"iface": "up", "optional": True}
    assert all(uplink in ports for ports in provider.ports.values())


def test_a_lost_gateway_is_succeeded_in_the_same_look(site: Site, journal: Journal) -> None:
    provider = Grouped()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2 and provider.gateways())
    (lost,) = elected(journal)
    provider.machines[lost] = replace(provider.machines[lost], state=MachineState.GONE, reason="killed")
    ours.reconcile()
    assert elected(journal) == [({"m1", "m2"} - {lost}).pop()]
    work(ours, lambda: provider.gateways() == elected(journal))
    ours.close()
    moved = [each for each in journal.events("c") if each.what == "gateway"]
    assert [each.detail for each in moved] == ["of edge: the first machine", f"of edge: {lost} is gone: killed"]


def test_a_gateway_with_a_notice_hands_over_and_keeps_its_uplink_until_it_is_gone(site: Site, journal: Journal) -> None:
    provider = Grouped()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(serving(journal)) == 2 and provider.gateways())
    (old,) = elected(journal)
    noticed = replace(provider.machines[old], state=MachineState.LEAVING, leaves_at_unix_s=time.time() + 60)
    provider.machines[old] = noticed
    provider.drain = lambda machine: None  # type: ignore[method-assign]  # it takes its time
    work(ours, lambda: elected(journal) != [old] and len(provider.gateways()) == 2)
    del provider.machines[old]
    work(ours, lambda: provider.gateways() == elected(journal))
    ours.close()


@pytest.mark.parametrize("written", ["before the act", "not at all"])
def test_a_supervisor_that_begins_again_finds_the_gateway(site: Site, journal: Journal, written: str) -> None:
    provider = Grouped()
    first = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(first, lambda: len(serving(journal)) == 2 and provider.gateways())
    first.close()
    (kept,) = elected(journal)
    (other,) = {"m1", "m2"} - {kept}
    if written == "before the act":
        provider.detach_uplink(f"id-{kept}")
    else:
        provider.attach_uplink(f"id-{other}")
    second = supervisor(site, journal, provider)
    work(second, lambda: provider.gateways() == [kept] == elected(journal))
    second.close()


def test_an_uplink_that_cannot_be_attached_is_reported_once_and_tried_again(site: Site, journal: Journal) -> None:
    provider = Grouped()
    provider.fails = 5
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, provider.gateways)
    ours.close()
    (trouble,) = [each.detail for each in journal.events("c") if each.what == "trouble"]
    assert trouble in {"m1: attach uplink: not now", "m2: attach uplink: not now"}  # both are begun at once


def test_the_gateway_is_one_for_all_clusters_of_a_site(site: Site, journal: Journal) -> None:
    provider = Grouped()
    provider.describe = lambda cluster: [  # type: ignore[method-assign]
        each for each in provider.machines.values() if each.spec.cluster == cluster
    ]
    numbers = iter(range(1, 9))
    journal.next_machine = lambda cluster: f"m{next(numbers)}"  # type: ignore[method-assign]
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    journal.put_cluster(replace(PLAN, name="d"), time.time())
    work(ours, lambda: len(serving(journal)) == 2 and len(provider.machines) == 4 and provider.gateways())
    assert len(provider.gateways()) == 1
    journal.unwant("c", "test", time.time())
    work(ours, lambda: not journal.machines("c", gone=False) and len(provider.gateways()) == 1)
    ours.close()
    (kept,) = provider.gateways()
    assert provider.machines[kept].spec.cluster == "d"
