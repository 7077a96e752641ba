"""Site configuration of a launcher: addresses, devices and defaults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fog.site import SiteConfig, open_site, save_topology, topology_now, with_gateway
from gdp.control.endpoints import Endpoint
from gdp.enrolment.create import DomainPlan, create_domain
from gdp.errors import ConfigError, LocalError

WHEEL = f"https://example.org/gdp_ros.whl#sha256={'0a' * 32}"
INSTALLS = f"aws: {{setup: {{requirements: ['{WHEEL}']}}}}\n"


def site(folder: Path, *lines: str) -> SiteConfig:
    for name in ("domain", "owner"):
        (folder / name).mkdir()
    path = folder / "fog.yaml"
    path.write_text("\n".join(["domain: domain", "owner: owner", *lines]))
    return SiteConfig.load(path)


def border(folder: Path, *lines: str, public: str = "198.51.100.7:51820") -> Path:
    """Create a domain on this host, and return a ``fog.yaml`` that names it as the border."""
    host = public.rpartition(":")[0]
    plan = DomainPlan(
        name="lab",
        directory=folder / "border",
        public=[Endpoint.from_text(public)],
        servers=[f"{host}:51820"],
        listen=51_820,
    )
    create_domain(plan)
    path = folder / "fog.yaml"
    path.write_text("\n".join(["border: border", "state: state", *lines]))
    return path


def test_machines_here_have_the_device_that_is_made_for_them(tmp_path: Path) -> None:
    assert site(tmp_path).device == "eth0"


@pytest.mark.parametrize("provider", ["aws", "skypilot"])
def test_machines_with_no_way_to_the_robot_are_refused(tmp_path: Path, provider: str) -> None:
    with pytest.raises(ConfigError, match=r"name in border the directory"):
        site(tmp_path, f"provider: {provider}", f"{provider}: {{setup: {{requirements: ['{WHEEL}']}}}}")


def test_machines_of_this_host_join_no_border(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="name domain and owner instead of border"):
        SiteConfig.load(border(tmp_path))


def test_a_site_has_one_domain(tmp_path: Path) -> None:
    for name in ("domain", "owner"):
        (tmp_path / name).mkdir()
    path = border(tmp_path, "domain: domain", "owner: owner", "provider: aws", INSTALLS)
    with pytest.raises(ConfigError, match=r"domain, owner: those of the border are used"):
        SiteConfig.load(path)


def test_a_site_without_a_domain_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fog.yaml"
    path.write_text("state: state")
    with pytest.raises(ConfigError, match="name domain and owner, or border"):
        SiteConfig.load(path)


def test_a_border_gives_its_site_domain_robot_revocations_and_watch(tmp_path: Path) -> None:
    own = open_site(border(tmp_path, "provider: aws", INSTALLS))
    at = tmp_path / "border"
    assert (own.authority.domain, own.authority.owner) == (at / "domain", at / "owner")
    assert own.robots == (at / "proxy.yaml",)
    assert own.revocations == (at / "revocations", at / "switch.yaml")
    assert own.watch is not None
    assert own.watch[1] == "watch0"


@pytest.mark.parametrize("public", ["198.51.100.7:51820", "[2001:db8::7]:51820"])
def test_rented_machines_fetch_their_software_at_the_border(tmp_path: Path, public: str) -> None:
    own = open_site(border(tmp_path, "provider: aws", INSTALLS, public=public))
    assert own.config.software_address == f"{public.rpartition(':')[0]}:4781"
    assert own.software_listens == ("", 4781)


@pytest.mark.parametrize("address", ["launcher", "launcher:0", "launcher:70000", "fd00::1:4780", "'*:4780'", "':4780'"])
def test_an_address_that_machines_cannot_reach_is_refused(tmp_path: Path, address: str) -> None:
    with pytest.raises(ConfigError, match=r"software\.address"):
        site(tmp_path, f"software: {{address: {address}}}")


@pytest.mark.parametrize("topology", ["replica", "{gateway: edge, replica: true}"])
def test_a_machine_may_be_the_gateway(tmp_path: Path, topology: str) -> None:
    assert site(tmp_path, f"topology: {topology}").topology.replica


def test_a_wrong_topology_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"fog\.yaml:3:\d+: topology.*expected the word 'replica'"):
        site(tmp_path, "topology: replicas")


def test_gateways_are_made_by_the_provider_local_only(tmp_path: Path) -> None:
    path = border(tmp_path, "provider: aws", INSTALLS, "topology: replica")
    with pytest.raises(ConfigError, match="topology is for the provider local"):
        SiteConfig.load(path)


def test_the_gateway_of_a_site_of_its_own_is_kept_from_launch_to_launch(tmp_path: Path) -> None:
    own = open_site(None, tmp_path / "state")
    assert not own.topology.replica
    save_topology(with_gateway(own, is_replica=True))
    assert open_site(None, tmp_path / "state").topology.replica
    assert topology_now(own).replica
    assert open_site(None, tmp_path / "state").id == own.id


def test_what_a_file_states_no_option_changes(tmp_path: Path) -> None:
    stated = replace(open_site(None, tmp_path / "state"), file=tmp_path / "fog.yaml")
    with pytest.raises(LocalError, match="set 'topology' there"):
        with_gateway(stated, is_replica=True)
