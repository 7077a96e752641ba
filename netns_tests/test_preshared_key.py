"""Preshared keys of real tunnels: the same at both ends, in force after a rekey, and no obstacle after a kill."""

from __future__ import annotations

import os
import shutil
import socket
import time
from dataclasses import dataclass

import pytest

from gdp.control.tunnel_plan import underlay_ifname
from gdp.ports.tunnel.uapi import socket_path
from gdp.stores.keyring import CARD, load_card
from internet.access import Access
from internet.host import Host
from internet.laboratory import Laboratory
from internet.overlay import Overlay
from lab.process import until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about tunnels, no lease of a name matters"),
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="wireguard-go needs root for its control socket"),
]

PATIENCE_S = 60.0
RECOVERY_S = 20.0  # a start of the switch, and the bound of tests/gdp/control/test_preshared_key.py
REKEY_S = 120.0  # WireGuard paper, section 6.1
NONE = "0" * 64


@dataclass
class Pair:
    """A border and a robot behind a NAT, with a tunnel between them."""

    overlay: Overlay
    border: Host
    robot: Host

    def key(self, host: Host) -> str:
        """Return the preshared key that WireGuard has at a host."""
        name = load_card(self.overlay.directory(host) / "switch" / CARD).name
        with socket.socket(socket.AF_UNIX) as control:
            control.connect(str(socket_path(underlay_ifname(name, 0))))
            control.sendall(b"get=1\n\n")
            reply = b""
            while not reply.endswith(b"\n\n"):
                reply += control.recv(1 << 16)
        lines = [line for line in reply.decode().splitlines() if line.startswith("preshared_key=")]
        return lines[0].partition("=")[2] if lines else NONE

    def is_up(self) -> bool:
        """Return whether hellos cross the tunnel both ways."""
        return all(each["up"] for host in (self.border, self.robot) for each in self.overlay.tunnels(host).values())

    def has_key(self) -> bool:
        """Return whether both ends have the same key."""
        return self.is_up() and self.key(self.border) == self.key(self.robot) != NONE

    def is_preshared(self) -> bool:
        """Return whether both ends say that their sessions have the key."""
        hosts = self.border, self.robot
        return all(each["preshared"] for host in hosts for each in self.overlay.tunnels(host).values())


@pytest.fixture
def pair(laboratory: Laboratory) -> Pair:
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    robot = laboratory.add_host("robot", laboratory.add_site("home", Access.PORT_RESTRICTED))
    overlay = Overlay(laboratory, border, {"backend": "wireguard-go"})
    overlay.stand_up(robot)
    made = Pair(overlay, border, robot)
    until(made.has_key, "no key at both ends", PATIENCE_S)
    return made


@pytest.mark.parametrize("label", [pytest.param("border", marks=pytest.mark.nightly), "robot"])
def test_a_tunnel_with_a_killed_end_works_again_with_a_new_key(pair: Pair, label: str) -> None:
    before = pair.key(pair.border)
    host = pair.border if label == "border" else pair.robot
    pair.overlay.kill(host)
    begun_s = time.monotonic()
    pair.overlay.start(host)
    until(lambda: pair.has_key() and pair.key(host) != before, "no new key at both ends", PATIENCE_S)
    assert time.monotonic() - begun_s < RECOVERY_S


@pytest.mark.nightly
def test_a_session_has_the_key_after_its_rekey_and_frames_go_on_crossing(pair: Pair) -> None:
    key, begun_s = pair.key(pair.border), time.monotonic()
    until(lambda: pair.is_up() and pair.is_preshared(), "no session with the key", REKEY_S + PATIENCE_S)
    assert time.monotonic() - begun_s < REKEY_S + 20.0
    assert pair.key(pair.border) == pair.key(pair.robot) == key
