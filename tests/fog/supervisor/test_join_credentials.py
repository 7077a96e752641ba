"""Supervisor of machines that join the border's domain."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from fog.bootstrap.domain_members import DomainMembers
from fog.host.bundle import JOIN_FILE
from fog.machine import MachineBundle, MachineSpec
from fog.site import Site, open_site
from fog.supervisor.journal import Journal
from fog.supervisor.supervisor import Supervisor
from gdp.enrolment.domain_join import JoinRequest, join_domain
from gdp.trust.enrolment_wire import EnrolmentError, UnreachableError
from gdp.trust.join_token import JoinToken
from tests.fog.supervisor.test_supervisor import PLAN, Memory, work
from tests.fog.test_site import WHEEL
from tests.gdp.enrolment.lab import Lab, running_lab

ONE = replace(PLAN, machines=PLAN.machines[:1])


class Cloud(Memory):
    """Provider that keeps the bundles of its machines."""

    def __init__(self) -> None:
        super().__init__()
        self.boots: dict[str, MachineBundle] = {}

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        self.boots[spec.name] = boot
        return super().create(spec, boot)

    def token(self, name: str) -> JoinToken:
        return JoinToken.from_text(json.loads(self.boots[name].files[JOIN_FILE])["token"])


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with running_lab(tmp_path) as made:
        yield made


@pytest.fixture
def site(lab: Lab) -> Site:
    path = lab.folder / "fog.yaml"
    path.write_text(f"border: lab\nstate: state\nprovider: aws\naws: {{setup: {{requirements: ['{WHEEL}']}}}}\n")
    return replace(open_site(path), watch=None)


@pytest.fixture
def journal(site: Site) -> Iterator[Journal]:
    with closing(Journal(site.journal)) as made:
        yield made


@pytest.fixture
def ours(lab: Lab, site: Site, journal: Journal) -> Iterator[tuple[Supervisor, Cloud]]:
    provider = Cloud()
    with closing(DomainMembers(lab.files)) as members:
        made = Supervisor(
            site=site,
            journal=journal,
            members=members,
            provider=provider,
            command=lambda _: ("run",),
        )
        journal.put_cluster(ONE, time.time())
        work(made, lambda: "m1" in provider.boots and journal.machines("c")[0].id)
        yield made, provider
        made.close()


def joined_label(lab: Lab, provider: Cloud) -> str:
    """Let the first machine join, and return its label."""
    lab.join("c-m1", provider.token("m1"))
    return "c-m1"


def test_a_machine_that_joined_is_recorded_and_gets_its_delegations(
    lab: Lab, journal: Journal, ours: tuple[Supervisor, Cloud]
) -> None:
    supervisor, provider = ours
    label = joined_label(lab, provider)
    work(supervisor, lambda: journal.machines("c")[0].issued_credentials.proxy)
    with closing(lab.registry()) as registry:
        machine = registry.machine_with(label)
        assert machine is not None
        (proxy,) = (each for each in machine.nodes if each.role == "proxy")
        assert journal.machines("c")[0].issued_credentials.proxy == proxy.name.to_text()
        assert not registry.has_mail(proxy.name)
    assert [each.what for each in journal.events("c") if each.machine == "m1"].count("enrolled") == 1


def test_a_machine_that_is_lost_is_removed_from_the_domain(
    lab: Lab, journal: Journal, ours: tuple[Supervisor, Cloud]
) -> None:
    supervisor, provider = ours
    label = joined_label(lab, provider)
    work(supervisor, lambda: journal.machines("c")[0].issued_credentials.proxy)
    del provider.machines["m1"]
    work(supervisor, lambda: "m2" in provider.boots)
    with closing(lab.registry()) as registry:
        assert registry.machine_with(label) is None
    assert list(lab.files.config.peers.glob("*.endpoints")) == []


def test_a_cluster_that_is_down_leaves_no_member_and_no_token(
    lab: Lab, journal: Journal, ours: tuple[Supervisor, Cloud]
) -> None:
    supervisor, provider = ours
    journal.unwant("c", "test", time.time())
    work(supervisor, lambda: supervisor.is_done)
    with pytest.raises(EnrolmentError, match="did not make the token"):
        joined_label(lab, provider)


def test_a_rented_machine_whose_token_is_used_again_is_an_alarm_and_replaced(
    lab: Lab, journal: Journal, ours: tuple[Supervisor, Cloud]
) -> None:
    supervisor, provider = ours
    joined_label(lab, provider)
    work(supervisor, lambda: journal.machines("c")[0].issued_credentials.proxy)
    thief = JoinRequest(token=provider.token("m1"), label="c-m1", directory=lab.folder / "thief")
    with pytest.raises(EnrolmentError, match="used already"):
        join_domain(thief)
    work(supervisor, lambda: list(provider.machines) == ["m2"])
    assert [each.machine for each in journal.events("c") if each.what == "alarm"] == ["m1"]


def test_a_removal_that_failed_is_tried_again(
    lab: Lab, journal: Journal, ours: tuple[Supervisor, Cloud], monkeypatch: pytest.MonkeyPatch
) -> None:
    supervisor, provider = ours
    label = joined_label(lab, provider)
    work(supervisor, lambda: journal.machines("c")[0].issued_credentials.proxy)

    def fail(*_: object, **__: object) -> None:
        raise UnreachableError("not now")

    with monkeypatch.context() as patch:
        patch.setattr(DomainMembers, "remove", fail)
        journal.unwant("c", "test", time.time())
        work(supervisor, lambda: any("not removed: not now" in each.detail for each in journal.events("c")))
    supervisor.reconcile()
    with closing(lab.registry()) as registry:
        assert registry.machine_with(label) is None
