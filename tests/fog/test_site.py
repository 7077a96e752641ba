"""Site configuration of a launcher: addresses, devices and defaults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fog.site import SiteConfig, open_site, save_topology, topology_now, with_gateway
from gdp.errors import ConfigError, LocalError

WHEEL = f"https://example.org/gdp_ros.whl#sha256={'0a' * 32}"
TUNNEL = f"aws: {{setup: {{requirements: ['{WHEEL}'], vxlan: {{remote: 198.51.100.7}}}}}}\n"


def site(folder: Path, *lines: str) -> SiteConfig:
    for name in ("domain", "owner"):
        (folder / name).mkdir()
    path = folder / "fog.yaml"
    path.write_text("\n".join(["domain: domain", "owner: owner", *lines]))
    return SiteConfig.load(path)


def test_machines_here_have_the_device_that_is_made_for_them(tmp_path: Path) -> None:
    assert site(tmp_path).device == "eth0"


def test_machines_elsewhere_meet_the_overlay_by_their_tunnel(tmp_path: Path) -> None:
    assert site(tmp_path, "provider: aws", TUNNEL).device == "fog0"


def test_a_device_that_is_not_the_tunnels_is_refused_before_anything_costs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"machine_iface is eth0.*vxlan is fog0"):
        site(tmp_path, "provider: aws", "machine_iface: eth0", TUNNEL)


@pytest.mark.parametrize("provider", ["aws", "skypilot"])
def test_machines_with_no_way_to_the_robot_are_refused(tmp_path: Path, provider: str) -> None:
    with pytest.raises(ConfigError, match=rf"{provider}\.setup\.vxlan"):
        site(tmp_path, f"provider: {provider}", f"{provider}: {{setup: {{requirements: ['{WHEEL}']}}}}")


def test_a_tunnel_of_ones_own_is_named(tmp_path: Path) -> None:
    installs = f"skypilot: {{setup: {{requirements: ['{WHEEL}']}}}}"
    enrols = "enrolment: {address: 'launcher.example.org:4780'}"
    assert site(tmp_path, "provider: skypilot", "machine_iface: tap0", installs, enrols).device == "tap0"


def test_rented_machines_enrol_at_the_tunnels_end_by_default(tmp_path: Path) -> None:
    assert site(tmp_path, "provider: aws", TUNNEL).enrolment_address == "198.51.100.7:4780"


def test_machines_that_do_not_know_where_to_enrol_are_refused_before_anything_costs(tmp_path: Path) -> None:
    installs = f"skypilot: {{setup: {{requirements: ['{WHEEL}']}}}}"
    with pytest.raises(ConfigError, match=r"set enrolment\.address"):
        site(tmp_path, "provider: skypilot", "machine_iface: tap0", installs)


@pytest.mark.parametrize("address", ["launcher", "launcher:0", "launcher:70000", "fd00::1:4780", "'*:4780'", "':4780'"])
def test_an_address_that_machines_cannot_reach_is_refused(tmp_path: Path, address: str) -> None:
    with pytest.raises(ConfigError, match=r"enrolment\.address"):
        site(tmp_path, f"enrolment: {{address: {address}}}")


def test_the_supervisor_listens_at_the_configured_address(tmp_path: Path) -> None:
    for name in ("domain", "owner"):
        (tmp_path / name).mkdir()
    (tmp_path / "fog.yaml").write_text(
        f"domain: domain\nowner: owner\nstate: state\nprovider: aws\n{TUNNEL}"
        "enrolment: {address: 'launcher.example.org:443', listen: '[fd00::1]:8443'}\n"
    )
    own = open_site(tmp_path / "fog.yaml")
    assert own.enrolment_url == "tcp://launcher.example.org:443"
    assert own.enrolment_listens == ("fd00::1", 8443)


@pytest.mark.parametrize("topology", ["replica", "{gateway: edge, replica: true}"])
def test_a_machine_may_be_the_gateway(tmp_path: Path, topology: str) -> None:
    assert site(tmp_path, f"topology: {topology}").topology.replica


def test_a_wrong_topology_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"fog\.yaml:3:\d+: topology.*expected the word 'replica'"):
        site(tmp_path, "topology: replicas")


def test_gateways_are_made_by_the_provider_local_only(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="topology is for the provider local"):
        site(tmp_path, "provider: aws", TUNNEL, "topology: replica")


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
