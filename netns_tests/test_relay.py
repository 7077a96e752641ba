"""Relay through TLS: two switches that only it joins, its faults, and what strangers and wrong conditions get.

A routed IPv4 cable joins border and member.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from gdp.crypto.certificates import Role
from gdp.names import Name
from gdp.ports.tap import tap_name
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import load_card, load_domain, load_identity
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from lab.credentials import grant
from lab.machine import LabMachine
from lab.namespaces import Space, cable
from lab.process import LabProcess, until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about the relay's connection, no lease matters"),
    pytest.mark.skipif(not os.access("/dev/net/tun", os.R_OK | os.W_OK), reason="no /dev/net/tun here"),
]

PORT = 443
BORDER_ADDRESS, MEMBER_ADDRESS, LATER_ADDRESS = "192.0.2.1", "192.0.2.2", "192.0.2.3"
HEAL_S = 10
_PUBLISH = """
with gdp.open("robot") as robot:
    publisher = robot.publisher("a")
    publisher.wait_for_readers(timeout_s=60)
    for number in range(100):
        publisher.put(number.to_bytes(2, "big") * 4000)
    publisher.flush(timeout_s=60)
"""
_READ = """
with gdp.open("server") as server:
    subscription = server.subscribe("a")
    print("reads", flush=True)
    print([int.from_bytes(subscription.receive(60).payload[:2], "big") for _ in range(100)] == list(range(100)))
"""

_PROBE = """
from http.client import HTTPConnection
asking = HTTPConnection("127.0.0.1", 9107)
asking.request("GET", "/readyz")
answer = asking.getresponse()
print(answer.status, answer.read().decode())
"""


class Node(LabMachine):
    """One of the machines, with the identity of its switch."""

    def __init__(self, home: Path, label: str, enter: Sequence[str] = ()) -> None:
        super().__init__(home, enter)
        self.label = label
        self.name: Name = load_card(home / label / "node.card").name

    def devices(self) -> set[str]:
        """Return the names of the devices."""
        return {str(each["ifname"]) for each in self.links()}


class RelayLab:
    """The two machines."""

    def __init__(self, home: Path, into_member: Sequence[str]) -> None:
        self.home, self.domain = home, home / "domain"
        make_domain(self.domain, "lab", unix_s=time.time() - 30 * 86_400)
        for label in ("border", "member"):
            make_node(home / label, Role.SWITCH, label, self.domain, days=30, unix_s=time.time())
        self.border, self.member = Node(home, "border"), Node(home, "member", into_member)
        self.member_device = tap_name(self.member.name, self.border.name)

    def relay_config(self, node: Node, *, standby: bool = False, **more: object) -> Path:
        """Write the configuration of the relay of one machine."""
        endpoints = [f"{BORDER_ADDRESS}:{PORT}"]
        border = {"peer": self.border.name.to_text(), "endpoints": endpoints, "standby": standby}
        part: dict[str, object] = {"server": {"port": PORT}} if node is self.border else {"borders": [border]}
        socket = f"{node.label}-relay.sock"
        return node.write(f"{node.label}-relay", node.label, **{"control_socket": socket, **part, **more})

    def start_relay(self, node: Node, *, standby: bool = False, **more: object) -> LabProcess:
        """Start the relay of one machine."""
        return node.start("relay", self.relay_config(node, standby=standby, **more).stem)

    def start_relays(self) -> tuple[LabProcess, LabProcess]:
        """Start both relays; return border's and member's when frames may pass."""
        processes = self.start_relay(self.border), self.start_relay(self.member)
        until(self.is_up)
        return processes

    def start_switch(self, node: Node, **more: object) -> LabProcess:
        """Start the switch of one machine; its only links are the relay's devices."""
        keys = {"relay": True, "control_socket": f"{node.label}-switch.sock", "data_plane": "raw"}
        return node.start("switch", node.write(f"{node.label}-switch", node.label, **{**keys, **more}).stem)

    def link_peers(self) -> None:
        """Write the endpoint record of each machine for the other, so that a tunnel over UDP can join them."""
        for node, other in ((self.border, self.member), (self.member, self.border)):
            (self.home / f"{node.label}-peers").mkdir()
            record = self.home / f"{node.label}-peers/{other.label}.endpoints"
            where = ["--public", f"{BORDER_ADDRESS}:51820"] if other is self.border else []
            node.gdp("endpoints", other.label, *where, "-o", record)

    def tunnel_is_up(self) -> bool:
        """Return whether the member's switch has its border as a neighbour over UDP."""
        links = self.member.status("member-switch.sock")["links"]
        return bool(links and links[0]["up"])

    def neighbours(self, node: Node) -> int:
        """Return how many neighbours the switch of a machine has."""
        return int(node.status(f"{node.label}-switch.sock")["neighbours"])

    def relay_status(self, node: Node) -> dict[str, Any]:
        """Return the status of the relay of a machine."""
        return node.status(f"{node.label}-relay.sock")

    def is_up(self) -> bool:
        """Return whether the member's relay is connected."""
        return bool(self.relay_status(self.member)["borders"][0]["state"] == "up")

    def is_joined(self) -> bool:
        """Return whether both switches see each other."""
        return self.neighbours(self.border) == self.neighbours(self.member) == 1


@pytest.fixture
def lab(space: Space, tmp_path: Path) -> Iterator[RelayLab]:
    """Border in this namespace, and member in another one."""
    with cable(space) as there:
        lab = RelayLab(tmp_path, there.command([]))
        with lab.border, lab.member:
            for node, address in ((lab.border, BORDER_ADDRESS), (lab.member, MEMBER_ADDRESS)):
                node.output("ip", "addr", "add", f"{address}/24", "dev", "eth0")
            yield lab


def refusal(lab: RelayLab, config: Path, *before: str) -> str:
    """Return the sentence of a relay that does not start."""
    done = lab.border.run(*before, sys.executable, "-m", "gdp.cli.relay", "--config", str(config))
    assert done.returncode == 2, done.stderr
    return done.stderr.strip().splitlines()[-1]


def test_a_reliable_stream_crosses_between_switches_that_only_the_relay_joins(lab: RelayLab) -> None:
    make_owner(lab.home / "owner")
    for label, right in (("robot", Right.PUBLISH), ("server", Right.READ)):
        make_node(lab.home / label, Role.PROXY, label, lab.domain)
        grant(lab.home / "owner", lab.home / label, {"a": [right]})
    make_node(lab.home / "rib", Role.RIB, "rib", lab.domain)
    lab.start_relays()
    lab.start_switch(lab.border, attach=["rib0", "server0"])
    lab.start_switch(lab.member, attach=["robot0"])
    lab.border.write("rib", "rib", iface="rib0")
    lab.border.start("rib", "rib")
    reader = lab.border.launch([sys.executable, "-c", "import gdp" + _READ])
    assert reader.read_line(60.0) == b"reads"
    lab.member.output(sys.executable, "-c", "import gdp" + _PUBLISH)
    assert reader.output() == "True\n"
    status = lab.relay_status(lab.border)
    assert status["via"] == "tls (slower)"
    assert status["bytes_in"] > 100 * 8_000


def test_a_killed_relay_leaves_nothing_and_heals_when_it_starts_again(lab: RelayLab) -> None:
    border, member = lab.start_relays()
    for node in (lab.border, lab.member):
        lab.start_switch(node)
    until(lab.is_joined)
    lab.border.kill(border)
    assert lab.border.devices() == {"lo", "eth0"}, "a device that outlives its relay"
    until(lambda: lab.neighbours(lab.member) == 0)
    lab.start_relay(lab.border)
    until(lab.is_joined)
    lab.member.kill(member)
    assert lab.member.devices() == {"lo", "eth0"}
    lab.start_relay(lab.member)
    until(lab.is_joined)


def test_a_relay_answers_probes_and_is_ready_once_it_has_its_border(lab: RelayLab) -> None:
    def is_ready() -> bool:
        done = lab.member.run(sys.executable, "-c", _PROBE)
        assert done.returncode == 0, done.stderr
        code, text = done.stdout.split(" ", 1)
        assert (code == "200") is json.loads(text)["ready"], text
        return code == "200"

    lab.start_relay(lab.member, metrics={"port": 9107})
    assert not is_ready()
    until(lambda: "no connection to border" in lab.member.run(sys.executable, "-c", _PROBE).stdout)
    lab.start_relay(lab.border)
    until(is_ready)


@pytest.mark.nightly
def test_a_change_of_address_is_followed_without_waiting_for_a_timeout(lab: RelayLab) -> None:
    lab.start_relay(lab.border, dead_ms=HEAL_S * 1_000)
    lab.start_relay(lab.member, dead_ms=HEAL_S * 1_000)
    for node in (lab.border, lab.member):
        lab.start_switch(node)
    until(lab.is_joined)
    lab.member.output("ip", "addr", "del", f"{MEMBER_ADDRESS}/24", "dev", "eth0")
    lab.member.output("ip", "addr", "add", f"{LATER_ADDRESS}/24", "dev", "eth0")
    begun_s = time.monotonic()
    until(lambda: lab.relay_status(lab.border)["server"]["clients"][0]["address"] == LATER_ADDRESS)
    took_s = time.monotonic() - begun_s
    until(lab.is_joined)
    print(f"address change: {took_s * 1e3:.0f} ms")
    assert took_s < HEAL_S


@pytest.mark.nightly
def test_a_relay_on_standby_waits_for_a_tunnel_and_then_connects(lab: RelayLab) -> None:
    lab.start_relay(lab.border)
    relay = lab.start_relay(lab.member, standby=True)
    until(lab.is_up)
    assert "relay needed: no tunnel" in relay.logged


@pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed")
@pytest.mark.skipif(shutil.which("nft") is None, reason="nft is not installed")
def test_where_udp_becomes_blocked_frames_go_through_tls(lab: RelayLab) -> None:
    lab.link_peers()
    lab.start_relay(lab.border)
    lab.start_relay(lab.member, standby=True, switch_socket="member-switch.sock")
    for node, listen in ((lab.border, 51_820), (lab.member, 0)):
        lab.start_switch(node, links={"listen": listen, "peers": f"{node.label}-peers", "backend": "wireguard-go"})
    until(lab.tunnel_is_up)
    rules = "table inet blocked { chain out { type filter hook output priority 0; meta l4proto udp drop; }; }"
    lab.member.output("nft", rules)
    begun_s = time.monotonic()
    until(lambda: not lab.tunnel_is_up() and lab.is_joined())
    print(f"UDP blocked: joined through TLS after {time.monotonic() - begun_s:.1f} s")
    (row,) = lab.member.status("member-switch.sock")["relay"]
    assert (row["peer"], row["via"], row["up"]) == (lab.border.name.to_text(), "tls (slower)", True)
    lab.member.run("nft", "delete", "table", "inet", "blocked")
    until(lab.tunnel_is_up)
    assert lab.is_up(), "the relay stays until the tunnel has been stable"


@pytest.mark.nightly
def test_an_endpoint_may_be_a_host_name(lab: RelayLab) -> None:
    lab.start_relay(lab.border)
    border = {"peer": lab.border.name.to_text(), "endpoints": [f"localhost:{PORT}"], "standby": False}
    with Node(lab.home, "member") as guest:  # in the namespace of the border, where this name leads to it
        guest.start("relay", lab.relay_config(lab.member, borders=[border]).stem)
        until(lab.is_up)


@pytest.mark.nightly
def test_a_port_that_the_configuration_names_is_not_added_twice(lab: RelayLab) -> None:
    lab.start_relays()
    lab.start_switch(lab.border)
    ports = [{"iface": lab.member_device, "optional": True, "cost": 100}]
    lab.start_switch(lab.member, ports=ports)
    until(lab.is_joined)
    assert lab.member.status("member-switch.sock")["ports"] == 1


@pytest.mark.nightly
def test_a_path_that_goes_silent_takes_the_carrier_away(lab: RelayLab) -> None:
    lab.start_relays()
    lab.border.output("ip", "link", "set", "eth0", "down")
    lab.border.output("ip", "link", "set", "eth0", "up")
    lab.member.output("ip", "neigh", "replace", BORDER_ADDRESS, "lladdr", "02:00:00:00:00:99", "dev", "eth0")
    until(lambda: not lab.is_up(), patience_s=HEAL_S)
    (device,) = (each for each in lab.member.links() if each["ifname"] == lab.member_device)
    assert "LOWER_UP" not in device["flags"]


def test_a_member_is_revoked_while_it_is_connected(lab: RelayLab) -> None:
    revocations = lab.home / "revoked"
    revocations.mkdir()
    lab.start_relay(lab.border, revocations="revoked")
    lab.start_relay(lab.member)
    until(lab.is_up)
    authority, found = load_domain(lab.domain), load_identity(lab.home / "member", time.time()).member
    wire = Revocation.make(authority.key, authority.root.signer, found.fingerprint, found.not_after_unix_s)
    (revocations / "member.revocation").write_bytes(wire)
    until(lambda: not lab.is_up(), patience_s=HEAL_S)
    assert "no longer valid" in lab.relay_status(lab.member)["borders"][0]["reason"]


def test_a_client_that_the_border_does_not_relay_for_shows_why(lab: RelayLab) -> None:
    lab.start_relay(lab.border, server={"port": PORT, "allow": ["another"]})
    lab.start_relay(lab.member)
    reason = "the border does not relay for member (relay allow)"
    until(lambda: lab.relay_status(lab.member)["borders"][0]["reason"] == reason)
    assert lab.relay_status(lab.border)["server"]["last_refusal"] == reason
    assert lab.border.devices() == {"lo", "eth0"}


def test_idle_strangers_do_not_keep_a_member_out(lab: RelayLab) -> None:
    lab.start_relay(lab.border)
    strangers = [socket.create_connection((BORDER_ADDRESS, PORT)) for _ in range(100)]
    try:
        lab.start_relay(lab.member)
        until(lab.is_up)
    finally:
        for each in strangers:
            each.close()


def test_ctrl_c_ends_a_relay_and_removes_its_devices(lab: RelayLab) -> None:
    relays = lab.start_relays()
    for each in relays:
        each.finish()
    assert [each.code for each in relays] == [0, 0]
    assert lab.border.devices() == lab.member.devices() == {"lo", "eth0"}


def test_a_relay_that_runs_already_is_named(lab: RelayLab) -> None:
    lab.start_relay(lab.border)
    assert "this relay already runs, pid " in refusal(lab, lab.relay_config(lab.border))


def test_wrong_conditions_get_one_sentence(lab: RelayLab) -> None:
    config = lab.relay_config(lab.border)
    with socket.create_server((BORDER_ADDRESS, PORT)):
        assert "port 443 is in use by another program" in refusal(lab, config)
    stripped = ("setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin", "--")
    assert "run this as root" in refusal(lab, config, *stripped)
    hidden = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs none /dev/net && exec "$@"', "sh")
    assert "there is no TUN/TAP driver" in refusal(lab, config, *hidden)
    assert lab.border.devices() == {"lo", "eth0"}


def test_an_expired_certificate_ends_the_start_with_a_sentence(lab: RelayLab) -> None:
    make_node(lab.home / "old", Role.SWITCH, "old", lab.domain, days=1, unix_s=time.time() - 9 * 86_400, force=True)
    assert "expired" in refusal(lab, lab.border.write("old", "old", server={"port": PORT}))


def test_a_clock_that_is_hours_off_ends_the_start_with_a_sentence(lab: RelayLab) -> None:
    make_domain(lab.home / "later", "later", unix_s=time.time() + 9 * 3_600)
    make_node(lab.home / "new", Role.SWITCH, "new", lab.home / "later", unix_s=time.time() + 9 * 3_600)
    path = lab.border.write("new", "new", server={"port": PORT})
    assert "not valid yet" in refusal(lab, path)
