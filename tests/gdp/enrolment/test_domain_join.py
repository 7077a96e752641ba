"""A machine joins a domain over loopback with a token."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.config.config import SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.config.store_config import StoreConfig
from gdp.control.endpoints import CandidateType, EndpointRecord
from gdp.crypto.certificates import Role
from gdp.enrolment import service_units
from gdp.enrolment.member_files import MemberFiles
from gdp.enrolment.programs import read_machine
from gdp.enrolment.service_units import service_texts
from gdp.nodes.membership import load_policy
from gdp.session.settings import settings_of
from gdp.stores.keyring import load_identity
from gdp.trust.join_token import JoinRole
from tests.gdp.enrolment.lab import Lab, running_lab


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with running_lab(tmp_path_factory.mktemp("join")) as made:
        yield made


def test_a_robot_becomes_a_leaf_switch_and_a_proxy_of_the_domain(lab: Lab) -> None:
    lab.join("robot")
    now = time.time()
    assert load_identity(lab.folder / "robot/switch", now).role is Role.LEAF
    assert load_identity(lab.folder / "robot/proxy", now).role is Role.PROXY
    assert load_identity(lab.folder / "robot/proxy", now).root.label == "lab"


def test_a_holder_has_an_identity_that_a_proxy_has_elsewhere_and_runs_its_store(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_units, "_PRIVATE_TMP", ())
    lab.join("archive", lab.token(JoinRole.HOLDER))
    files = MemberFiles.load(lab.folder / "archive")
    holds = StoreConfig.load(files.directory / "store.yaml")
    assert load_identity(holds.identity, time.time()).role is Role.PROXY
    assert files.mail_identity == holds.identity
    assert [each.name for each in files.nodes] == ["switch", "store"]
    assert settings_of(files.directory / "store").iface == holds.iface
    assert holds.iface in SwitchConfig.load(files.directory / "switch.yaml").attach
    assert holds.holds.folder.is_dir()
    machine = read_machine(files.directory)
    assert [each.name for each in machine.programs] == ["switch", "store", "agent"]
    lines = service_texts(machine)["gdp-archive-store.service"].splitlines()
    (command,) = [line for line in lines if line.startswith("ExecStart=")]
    assert command.endswith(f"store serve --config {files.directory}/store.yaml --await-iface 60")
    assert "Type=exec" in lines
    assert "Restart=always" in lines
    (rights,) = [line.partition("=")[2].split() for line in lines if line.startswith("CapabilityBoundingSet=")]
    assert {"CAP_NET_RAW", "CAP_NET_ADMIN"} <= set(rights)
    (families,) = [line for line in lines if line.startswith("RestrictAddressFamilies=")]
    assert "AF_PACKET" in families.split(), "it has a device of the switch"


def test_a_member_of_a_domain_with_a_relay_dials_it_where_udp_is_blocked(tmp_path: Path) -> None:
    with running_lab(tmp_path, relay_port=8_443) as lab:
        lab.join("robot")
        relay = RelayConfig.load(tmp_path / "robot/relay.yaml")
        border = load_identity(lab.files.directory / "switch", time.time())
    assert SwitchConfig.load(tmp_path / "robot/switch.yaml").relay
    assert [(each.peer, each.endpoints) for each in relay.borders] == [(border.name, ("127.0.0.1:8443",))]


def test_the_border_gets_the_record_of_the_new_switch(lab: Lab) -> None:
    joined = lab.join("arm")
    name = joined.identities[0].name
    wire = (lab.files.config.peers / f"{name.to_text()}.endpoints").read_bytes()
    member = MemberFiles.load(lab.folder / "arm")
    record, _ = EndpointRecord.verified(wire, load_policy(member.domain), time.time())
    assert record.name == name
    assert all(each.type is not CandidateType.PUBLIC for each in record.candidates)
