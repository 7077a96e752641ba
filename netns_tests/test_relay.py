"""Relay through TLS: two switches that only it joins, its faults, and what strangers and wrong conditions get."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from gdp.crypto.certificates import Role
from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, load_domain, load_identity
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from netns_tests.relay_lab import (
    BORDER_ADDRESS,
    LATER_ADDRESS,
    MEMBER_ADDRESS,
    PORT,
    Node,
    RelayLab,
    relay_lab,
)
from netns_tests.spaces import Space
from tests.waiting import until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about the relay's connection, no lease matters"),
    pytest.mark.skipif(not os.access("/dev/net/tun", os.R_OK | os.W_OK), reason="no /dev/net/tun here"),
]

HEAL_S = 10
_PUBLISH = """
with gdp.open("robot") as robot:
    publisher = robot.publisher("a")
    publisher.wait_for_readers(timeout_s=60)
    for number in range(500):
        publisher.put(number.to_bytes(2, "big") * 4000)
    publisher.flush(timeout_s=60)
"""
_READ = """
with gdp.open("server") as server:
    subscription = server.subscribe("a")
    print("reads", flush=True)
    print([int.from_bytes(subscription.receive(60).payload[:2], "big") for _ in range(500)] == list(range(500)))
"""

_PROBE = """
from http.client import HTTPConnection
asking = HTTPConnection("127.0.0.1", 9107)
asking.request("GET", "/readyz")
answer = asking.getresponse()
print(answer.status, answer.read().decode())
"""


@pytest.fixture
def lab(space: Space, tmp_path: Path) -> Iterator[RelayLab]:
    with relay_lab(space, tmp_path) as made:
        yield made


def refusal(lab: RelayLab, config: Path, *before: str) -> str:
    """Return the sentence of a relay that does not start."""
    done = lab.border.run(*before, sys.executable, "-m", "gdp.cli.relay", "--config", str(config))
    assert done.returncode == 2, done.stderr
    return done.stderr.strip().splitlines()[-1]


def test_a_reliable_stream_crosses_between_switches_that_only_the_relay_joins(lab: RelayLab) -> None:
    make_owner(lab.home / "owner")
    for label, right in (("robot", Right.PUBLISH), ("server", Right.READ)):
        make_node(lab.home / label, Role.PROXY, label, lab.domain)
        (lab.home / label / "delegations").mkdir(exist_ok=True)
        metadata = Metadata({"kind": "topic", "name": "a"})
        install_delegation(lab.home / label, delegate(lab.home / "owner", lab.home / label / CARD, metadata, [right]))
    make_node(lab.home / "rib", Role.RIB, "rib", lab.domain)
    lab.start_relays()
    lab.start_switch(lab.border, attach=["rib0", "server0"])
    lab.start_switch(lab.member, attach=["robot0"])
    rib = lab.home / "rib.yaml"
    rib.write_text(yaml.safe_dump({"identity": "rib", "domain": {"root": "rib/root.crt"}, "iface": "rib0"}))
    lab.border.start("gdp.cli.rib", rib)
    reader = subprocess.Popen(
        [*lab.border.enter, sys.executable, "-c", "import gdp" + _READ],
        cwd=lab.home,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert reader.stdout is not None
    assert reader.stdout.readline() == "reads\n"
    done = lab.member.run(sys.executable, "-c", "import gdp" + _PUBLISH)
    assert done.returncode == 0, done.stderr
    out, _ = reader.communicate(timeout=60.0)
    assert out == "True\n"
    status = lab.relay_status(lab.border)
    assert status["via"] == "tls (slower)"
    assert status["bytes_in"] > 500 * 8_000


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
    lab.member.ip("addr", "del", f"{MEMBER_ADDRESS}/24", "dev", "eth0")
    lab.member.ip("addr", "add", f"{LATER_ADDRESS}/24", "dev", "eth0")
    took_s = until(lambda: lab.relay_status(lab.border)["server"]["clients"][0]["address"] == LATER_ADDRESS)
    until(lab.is_joined)
    print(f"address change: {took_s * 1e3:.0f} ms")
    assert took_s < HEAL_S


@pytest.mark.nightly
def test_a_relay_on_standby_waits_for_a_tunnel_and_then_connects(lab: RelayLab) -> None:
    lab.start_relay(lab.border)
    lab.start_relay(lab.member, standby=True)
    until(lab.is_up)
    assert "relay needed: no tunnel" in lab.member.log("gdp.cli.relay")


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
    done = lab.member.run("nft", rules)
    assert done.returncode == 0, done.stderr
    took_s = until(lambda: not lab.tunnel_is_up() and lab.is_joined())
    print(f"UDP blocked: joined through TLS after {took_s:.1f} s")
    (row,) = lab.member.status(lab.home / "member-switch.sock")["relay"]
    assert (row["peer"], row["via"], row["up"]) == (lab.border.name.to_text(), "tls (slower)", True)
    lab.member.run("nft", "delete", "table", "inet", "blocked")
    until(lab.tunnel_is_up)
    assert lab.is_up(), "the relay stays until the tunnel has been stable"


@pytest.mark.nightly
def test_an_endpoint_may_be_a_host_name(lab: RelayLab) -> None:
    lab.start_relay(lab.border)
    border = {"peer": lab.border.name.to_text(), "endpoints": [f"localhost:{PORT}"], "standby": False}
    guest = Node(lab.home, "member", lab.border.enter)  # in the namespace of the border, where this name leads to it
    try:
        guest.start("gdp.cli.relay", lab.relay_config(lab.member, borders=[border]))
        until(lab.is_up)
    finally:
        guest.end()


@pytest.mark.nightly
def test_a_port_that_the_configuration_names_is_not_added_twice(lab: RelayLab) -> None:
    lab.start_relays()
    lab.start_switch(lab.border)
    ports = [{"iface": lab.member_device, "optional": True, "cost": 100}]
    lab.start_switch(lab.member, ports=ports)
    until(lab.is_joined)
    assert lab.member.status(lab.home / "member-switch.sock")["ports"] == 1


@pytest.mark.nightly
def test_a_path_that_goes_silent_takes_the_carrier_away(lab: RelayLab) -> None:
    lab.start_relays()
    lab.border.ip("link", "set", "eth0", "down")
    lab.border.ip("link", "set", "eth0", "up")
    lab.member.ip("neigh", "replace", BORDER_ADDRESS, "lladdr", "02:00:00:00:00:99", "dev", "eth0")
    until(lambda: not lab.is_up(), patience_s=HEAL_S)
    (device,) = (each for each in lab.member.links() if each["ifname"] == lab.member_device)
    assert "LOWER_UP" not in device["flags"]


def test_a_member_is_revoked_while_it_is_connected(lab: RelayLab) -> None:
    revocations = lab.home / "revoked"
    revocations.mkdir()
    lab.start_relay(lab.border, revocations="revoked")
    lab.start_relay(lab.member)
    until(lab.is_up)
    authority, found = load_domain(lab.domain), load_identity(lab.member.identity, time.time()).member
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
        each.send(signal.SIGINT)
        each.reap(10.0)
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
    path = lab.home / "old.yaml"
    config = {"identity": "old", "domain": {"root": "old/root.crt"}, "server": {"port": PORT}}
    path.write_text(yaml.safe_dump(config))
    assert "expired" in refusal(lab, path)


def test_a_clock_that_is_hours_off_ends_the_start_with_a_sentence(lab: RelayLab) -> None:
    make_domain(lab.home / "later", "later", unix_s=time.time() + 9 * 3_600)
    make_node(lab.home / "new", Role.SWITCH, "new", lab.home / "later", unix_s=time.time() + 9 * 3_600)
    path = lab.home / "new.yaml"
    config = {"identity": "new", "domain": {"root": "new/root.crt"}, "server": {"port": PORT}}
    path.write_text(yaml.safe_dump(config))
    assert "not valid yet" in refusal(lab, path)
