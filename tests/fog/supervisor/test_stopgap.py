"""Machines on demand in place of spot machines, and a cluster that scales by schedule."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from fog.bootstrap.domain_members import DomainMembers
from fog.hardware import Hardware, Offer
from fog.machine import MachineBundle, MachineSpec
from fog.scaling import policy_from_keys
from fog.site import Site, open_site
from fog.supervisor.core.reconcile import Drain, Launch, Timeouts, decide
from fog.supervisor.core.record import Outcome
from fog.supervisor.journal import Journal
from fog.supervisor.placement import stopgap
from fog.supervisor.supervisor import Supervisor
from gdp.errors import StoreError
from tests.fog.supervisor.machines import NOW_S, OFFERS, offer, record, serving
from tests.fog.supervisor.machines import SPOT as PLAIN_SPOT
from tests.fog.supervisor.test_supervisor import PLAN, Memory, work
from tests.fog.supervisor.test_supervisor import serving as names_serving

SPOT = replace(PLAIN_SPOT, may_be_on_demand=True)
DEMAND = [offer(region, is_spot=False, usd=0.4) for region in ("east", "west", "south")]
PATIENCE = Timeouts()


class Short(Memory):
    """Provider that has no spot machine at times."""

    has_spot = False

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        return OFFERS if spot else DEMAND

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        if spec.offer.is_spot and not self.has_spot:
            raise StoreError("no spot capacity")
        return super().create(spec, boot)


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
        patience=Timeouts(spot_retry_s=0.2),
    )


def kinds(journal: Journal) -> list[bool]:
    return [each.spec.offer.is_spot for each in journal.machines("c", gone=False) if each.is_serving]


def test_one_on_demand_serves_until_a_spot_machine_is_to_be_had_and_then_goes(site: Site, journal: Journal) -> None:
    provider = Short()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, machines=(SPOT,)), time.time())
    work(ours, lambda: kinds(journal) == [False])
    assert [each for each in journal.events() if each.what == "requested"][-1].detail.count("no spot machine")
    provider.has_spot = True
    work(ours, lambda: kinds(journal) == [True])
    ours.close()


def test_a_spot_machine_that_must_be_one_waits(site: Site, journal: Journal) -> None:
    ours = supervisor(site, journal, Short())
    journal.put_cluster(replace(PLAN, machines=(PLAIN_SPOT,)), time.time())
    work(ours, lambda: sum(each.ending is Outcome.FAILED for each in journal.machines("c")) >= 3)
    assert kinds(journal) == []
    ours.close()


def test_a_cluster_follows_its_schedule_at_once(site: Site, journal: Journal) -> None:
    schedule = [{"days": "mon-sun", "from": "00:00", "to": "24:00", "min": 3}]
    policy = policy_from_keys({"min": 1, "max": 5, "schedule": schedule})
    provider = Memory()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, machines=(PLAIN_SPOT,), scale=policy), time.time())
    work(ours, lambda: len(names_serving(journal)) == 3)
    assert [each.detail for each in journal.events() if each.what == "scaled"] == [
        "1 -> 3 machines: at least 3 at this time"
    ]
    ours.close()


def stopgap_of(name: str, served_s: float) -> object:
    known = serving(name)
    return replace(known, spec=replace(known.spec, offer=DEMAND[0]), wanted=SPOT, served_unix_s=served_s)


def test_a_machine_on_demand_is_no_reason_to_ask_before_its_time() -> None:
    assert decide((SPOT,), [stopgap_of("m1", NOW_S - 599)], NOW_S, PATIENCE) == []  # type: ignore[list-item]


def test_in_its_place_only_a_spot_machine_is_tried() -> None:
    late = stopgap_of("m1", NOW_S - 600)
    assert decide((SPOT,), [late], NOW_S, PATIENCE) == [Launch(SPOT, is_spot_only=True)]  # type: ignore[list-item]


def test_it_is_drained_once_the_spot_machine_serves() -> None:
    late, spot = stopgap_of("m1", NOW_S - 700), replace(serving("m2"), wanted=SPOT)
    assert decide((SPOT,), [late, spot], NOW_S, PATIENCE) == [  # type: ignore[list-item]
        Drain("m1", "another took its place")
    ]


def test_failed_spot_machines_hold_no_region_back_for_one_on_demand() -> None:
    failed = [record(f"m{at}", region).ended(Outcome.FAILED, "none", NOW_S) for at, region in enumerate(("east",) * 5)]
    choice = stopgap(SPOT, DEMAND[:1], failed, NOW_S)
    assert choice is not None
    assert choice.offer.region == "east"


def test_a_machine_on_demand_above_the_budget_is_not_taken() -> None:
    assert stopgap(SPOT, DEMAND, [serving("m1")], NOW_S, budget_usd_per_h=0.4) is None
    assert stopgap(SPOT, DEMAND, [serving("m1")], NOW_S, budget_usd_per_h=0.5) is not None


def test_a_push_replaces_machines_which_serve_until_others_do(site: Site, journal: Journal) -> None:
    provider = Memory()
    ours = supervisor(site, journal, provider)
    journal.put_cluster(PLAN, time.time())
    work(ours, lambda: len(names_serving(journal)) == 2)
    before = set(names_serving(journal))
    journal.put_cluster(replace(PLAN, pushed_unix_s=time.time()), time.time())
    work(ours, lambda: len(names_serving(journal)) == 2 and not before & set(names_serving(journal)))
    ours.close()


def test_pushed_machines_are_drained_only_when_others_serve() -> None:
    old = serving("m1")
    assert decide((PLAIN_SPOT,), [old], NOW_S, PATIENCE, pushed_unix_s=NOW_S) == [Launch(PLAIN_SPOT)]
    new = serving("m2", asked_s=NOW_S + 1)
    assert decide((PLAIN_SPOT,), [old, new], NOW_S + 2, PATIENCE, pushed_unix_s=NOW_S) == [
        Drain("m1", "another took its place")
    ]
