"""Filter in front of the VXLAN devices of tunnels: frames from outside do not come out of a tunnel."""

from __future__ import annotations

import os
import select
import shutil
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.config.config import LinksConfig
from gdp.control.tunnel_plan import underlay_ifname
from gdp.crypto.certificates import Role
from gdp.links.tunnels import open_underlays
from gdp.ports.tunnel.outside_filter import OutsideFilter
from gdp.ports.tunnel.vxlan import VXLAN_PORT, make_vxlan
from gdp.stores.issue import make_domain, make_node
from netns_tests.tunnel_sites import ETHERTYPE, PATIENCE_S, VNI, Site, two_sites

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about devices, no lease matters"),
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root for the packet filter"),
]

OUTSIDE, ELSEWHERE = "2001:db8::1", "2001:db8::2"
LAST_PORT = 5_000
PAYLOAD = b"a frame of a stranger"
VXLAN_FLAGS = 0x0800_0000


@pytest.fixture
def sites() -> Iterator[tuple[Site, Site]]:
    with two_sites() as (one, two):
        for site, address in ((one, OUTSIDE), (two, ELSEWHERE)):
            for scope in ("all", "default", "u0"):
                site.space.set(f"ipv6/conf/{scope}/disable_ipv6", "0")
            site.ip("address", "add", f"{address}/64", "dev", "u0", "nodad")
        yield one, two


def comes_through(one: Site, two: Site, underlay: str, local: str) -> bool:
    """Return whether a frame that ``two`` sends to an address of ``one`` comes out of a VXLAN device there."""
    with one.entered(), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as last:
        last.bind(("::", LAST_PORT))
        remote = "fd00::2"
        make_vxlan(ifname=one.link, vni=VNI, local=local, remote=remote, underlay=underlay, mtu=1_280, alias=one.alias)
        out = one.frames()
        with two.entered(), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as stranger:
            frame = b"\xff" * 6 + b"\x02" * 6 + struct.pack("!H", ETHERTYPE) + PAYLOAD
            stranger.sendto(struct.pack("!II", VXLAN_FLAGS, VNI << 8) + frame, (OUTSIDE, VXLAN_PORT))
            stranger.sendto(b"", (OUTSIDE, LAST_PORT))  # it arrives after what was sent before
        assert select.select([last], [], [], PATIENCE_S)[0]
        try:
            return PAYLOAD in out.recv(2_000)
        except BlockingIOError:
            return False


@pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed")
def test_a90_frames_from_outside_come_out_of_no_tunnel(sites: tuple[Site, Site], tmp_path: Path) -> None:
    one, two = sites
    make_domain(tmp_path / "lab", "lab")
    identity = make_node(tmp_path / "switch", Role.SWITCH, "switch", tmp_path / "lab")
    with one.entered(), open_underlays(LinksConfig(backend="wireguard-go", listen=0), identity):
        assert not comes_through(one, two, underlay_ifname(identity.name, 0), one.inner)


def test_frames_from_a_device_inside_pass_the_filter(sites: tuple[Site, Site]) -> None:
    one, two = sites
    with one.entered():
        kept = OutsideFilter("gdp-test", VXLAN_PORT, ["u0"])
    assert comes_through(one, two, "u0", OUTSIDE)
    kept.close()
