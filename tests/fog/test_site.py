from __future__ import annotations

from pathlib import Path

import pytest

from fog.site import SiteConfig
from gdp.errors import ConfigError

TUNNEL = "aws: {setup: {vxlan: {remote: 198.51.100.7}}}\n"


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
        site(tmp_path, f"provider: {provider}")


def test_a_tunnel_of_ones_own_is_named(tmp_path: Path) -> None:
    assert site(tmp_path, "provider: skypilot", "machine_iface: tap0").device == "tap0"
