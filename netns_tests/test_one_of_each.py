"""Real switches, RIBs and proxies of one host: a second one is refused, and one that cannot work logs the reason."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.host.single_instance import lock_directory
from lab.machine import PROGRAMS, LabMachine, NodeProgram
from lab.namespaces import Space
from lab.process import LabProcess
from netns_tests.test_pairs import devices

pytestmark = pytest.mark.netns

_MACS = bytes.fromhex("020000000001"), bytes.fromhex("020000000002")
_PROXY = "identity: proxy\ndomain: {root: proxy/root.crt}\ndelegations: proxy/delegations\niface: proxy0\n"
_OTHER_HOST = (
    "unshare",
    "--mount",
    "sh",
    "-c",
    'mount -t tmpfs -o mode=700 locks "$0" && exec "$@"',
    str(lock_directory()),
)
Start = Callable[..., LabProcess]


@pytest.fixture
def start(machine: LabMachine, monkeypatch: pytest.MonkeyPatch) -> Start:
    """Factory of nodes of the lab ``robot`` and ``server`` in the thread's namespace; running nodes are ended."""
    monkeypatch.chdir(machine.folder)
    machine.gdp("lab", "robot", "server")
    Path("robot/proxy.yaml").write_text(_PROXY)

    def begin(host: str, what: NodeProgram, *options: str, on_another_host: bool = False) -> LabProcess:
        argv = [sys.executable, "-m", PROGRAMS[what], "--config", f"{host}/{what}.yaml", *options]
        return machine.launch([*(_OTHER_HOST if on_another_host else ()), *argv], heard=False)

    return begin


def says(node: LabProcess, *words: str) -> str:
    """Return the first line with these words, in this order, when it arrives."""
    return node.until_logged(".*".join(map(re.escape, words)))


def refused(node: LabProcess, *words: str) -> None:
    """Return when a node has ended with an error of these words."""
    says(node, *words)
    node.reap()
    assert node.code == 2


def test_a_second_switch_is_refused_and_leaves_the_first_ones_devices_alone(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    first = start("robot", "switch")
    says(first, " is up")
    rib = start("robot", "rib")
    says(rib, " is up")
    before = devices()
    second = start("robot", "switch", "--iface", "far0")
    refused(second, "error: this switch already runs, pid", str(first.pid), "robot/switch.yaml", "stop it first")
    assert devices() == before
    second_rib = start("robot", "rib")
    refused(second_rib, "error: this RIB already runs, pid", str(rib.pid))
    assert (first.code, rib.code) == (None, None)


def test_another_switch_on_the_same_device_is_refused(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    first = start("robot", "switch")
    says(first, " is up")
    second = start("server", "switch")
    refused(second, "error: eth0 is in use by another node, pid", str(first.pid))


def test_the_same_identity_is_refused_in_another_network_namespace_and_from_a_copied_folder(
    space: Space, start: Start
) -> None:
    space.veth("eth0", "far0", *_MACS)
    says(start("robot", "switch"), " is up")
    subprocess.run(["cp", "-rp", "robot", "copy"], check=True)
    with Space() as other:
        other.veth("eth0", "far0", *_MACS)
        second = start("copy", "switch")
    refused(second, "error: this switch already runs, pid")


@pytest.mark.nightly
def test_of_two_switches_with_one_identity_on_two_hosts_the_older_one_stays_and_both_say_so(
    space: Space, start: Start
) -> None:
    space.veth("eth0", "far0", *_MACS)
    space.veth("eth1", "far1", bytes.fromhex("020000000003"), bytes.fromhex("020000000004"))
    subprocess.run(["cp", "-rp", "robot", "copy"], check=True)
    head = Path("robot/switch.yaml").read_text().split("ports:")[0]
    for host, ports in (("robot", "eth0"), ("copy", "eth1"), ("server", "far0}, {iface: far1")):
        Path(host, "switch.yaml").write_text(f"{head}ports: [{{iface: {ports}}}]\n")
    says(start("server", "switch"), " is up")
    first = start("robot", "switch")
    says(first, "neighbour up port=eth0")
    second = start("copy", "switch", on_another_host=True)
    says(second, "waiting: another node with this identity")
    says(first, "another node with this identity is alive")
    first.kill_group()
    says(second, "neighbour up port=eth1")


def test_a_second_proxy_is_refused_and_a_killed_one_can_be_started_at_once(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    says(start("robot", "switch"), " is up")
    says(start("robot", "rib"), " is up")
    first = start("robot", "proxy")
    says(first, " is attached")
    second = start("robot", "proxy")
    refused(second, "error: this proxy already runs, pid", str(first.pid))
    first.kill_group()
    says(start("robot", "proxy"), " is attached")


def test_a_proxy_says_that_its_device_comes_with_a_switch(space: Space, start: Start) -> None:
    says(
        start("robot", "proxy", "--await-iface", "0.2"),
        "error: proxy0: no such device; start gdp-switch with attach: [proxy0] first",
    )


def test_a_switch_reports_that_its_link_is_down_and_then_that_no_neighbour_answers(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    space.ip("link", "set", "far0", "down")
    switch = start("robot", "switch")
    says(switch, "WARNING", "waiting: link down on eth0")
    says(switch, "WARNING", "waiting: no RIB of this domain can be reached")
    space.ip("link", "set", "far0", "up")
    says(switch, "WARNING", "waiting: no neighbour on eth0: no answer there")
    assert sum("link down" in line for line in switch.logged.splitlines()) == 1


@pytest.mark.nightly
def test_a_proxy_without_a_rib_says_so_and_is_attached_when_there_is_one(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    says(start("robot", "switch"), " is up")
    proxy = start("robot", "proxy", "--json")
    says(proxy, '"waiting"', '"no-rib"', "no RIB answers the switch")
    says(start("robot", "rib"), " is up")
    says(proxy, '"ready"')


@pytest.mark.nightly
def test_switches_of_two_domains_that_do_not_trust_each_other_say_so(space: Space, start: Start) -> None:
    space.veth("eth0", "far0", *_MACS)
    with pytest.raises(SystemExit):
        main(["lab", "other", "--domain", "stranger", "--iface", "far0"])
    file = Path("other/switch.yaml")
    file.write_text("".join(line for line in file.read_text().splitlines(True) if not line.startswith("attach")))
    one, other = start("robot", "switch", "-v"), start("other", "switch")
    says(one, "WARNING", "neighbour on eth0 of domain stranger, which is not trusted here")
    says(other, "WARNING", "neighbour on far0 of domain lab, which is not trusted here")
    assert "pyroute2" not in one.logged
