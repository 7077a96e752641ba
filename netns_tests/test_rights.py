"""Privileges of the real commands after their start: the kernel's view, and that later operations still work."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from fog.providers.cloud_init import Setup, placed
from gdp.crypto.certificates import Role
from gdp.ports.confine import landlock
from gdp.ports.confine.capabilities import Capability
from gdp.stores.keyring import DELEGATIONS
from gdp.trust.right import Right
from lab.credentials import make_nodes
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import FailedError, LabProcess

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about rights of processes, no lease matters"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root has capabilities to give away"),
]

DEVICE = {Capability.NET_ADMIN, Capability.NET_RAW}
BOUNDED = ("setpriv", "--bounding-set=-all,+net_raw,+net_admin,+bpf,+perfmon,+setpcap", "--")
TYPES = {"/a": "std_msgs/msg/Empty"}
ROLES = (Role.SWITCH, Role.RIB, Role.PROXY)


def status_of(node: LabProcess) -> dict[str, str]:
    """Return what the kernel says of a process."""
    lines = Path(f"/proc/{node.pid}/status").read_text().splitlines()
    return {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}


def capabilities_of(node: LabProcess) -> set[int]:
    mask = int(status_of(node)["CapEff"], 16)
    return {number for number in range(64) if mask >> number & 1}


def end(node: LabProcess) -> int | None:
    """End a node as Ctrl-C does, and return its exit code."""
    node.finish()
    return node.code


def configured(space: Space, machine: LabMachine) -> LabMachine:
    """Return the machine with the files of a switch, a RIB and a recording proxy; a link p0 to q0."""
    make_nodes(machine.folder, {each.value: each for each in ROLES}, {"proxy": {"/a": [Right.READ]}}, TYPES)
    for folder in ("kept", "revoked"):
        (machine.folder / folder).mkdir()
    ports = {"ports": [{"iface": "p0"}], "attach": ["rib0", "proxy0"]}
    machine.write("switch", "switch", **ports, revocations="revoked", metrics={"port": 9471})
    machine.write("rib", "rib", iface="rib0", snapshot="kept/routes")
    rule = {"name": "/a", "type": TYPES["/a"], "owner": "owner/owner.pub"}
    places = {"delegations": f"proxy/{DELEGATIONS}", "record": {"path": "kept/received.mcap"}}
    machine.write("proxy", "proxy", iface="proxy0", **places, **{"import": [rule]})
    space.veth("p0", "q0", bytes.fromhex("02000000aa01"), bytes.fromhex("02000000aa02"))
    return machine


@pytest.fixture
def nodes(space: Space, machine: LabMachine) -> LabMachine:
    return configured(space, machine)


def start_all(machine: LabMachine) -> tuple[LabProcess, LabProcess, LabProcess]:
    """Start the switch, the RIB and the proxy."""
    switch = machine.start("switch", "switch", "--data-plane", "raw")
    rib = machine.launch_node("rib", "rib", "--await-iface", "30")
    proxy = machine.launch_node("proxy", "proxy", "--await-iface", "30")
    return switch, machine.ready(rib), machine.ready(proxy)


def assert_fenced(node: LabProcess, kept: set[Capability]) -> None:
    node.until_logged(" rights ")
    status = status_of(node)
    assert capabilities_of(node) == kept
    assert int(status["CapBnd"], 16) == 0
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    assert f"landlock={landlock.abi() or 'none'}" in node.logged
    threads = [task / "status" for task in Path(f"/proc/{node.pid}/task").iterdir()]
    assert all(f"CapEff:\t{status['CapEff']}\n" in each.read_text() for each in threads)


def test_a53_commands_that_are_up_keep_only_what_they_need(nodes: LabMachine, space: Space) -> None:
    switch, rib, proxy = start_all(nodes)
    for node in (switch, rib, proxy):
        assert_fenced(node, DEVICE)
    space.ip("link", "delete", "p0")
    switch.until_logged("port=p0 up=False")
    space.veth("p0", "q0", bytes.fromhex("02000000aa01"), bytes.fromhex("02000000aa02"))
    switch.until_logged("port=p0 up=True")
    switch.send(signal.SIGHUP)
    assert [end(proxy), end(rib), end(switch)] == [0, 0, 0]
    assert {path.name for path in (nodes.folder / "kept").iterdir()} == {"received.mcap", "routes"}
    left = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
    assert "rib0" not in left
    assert "proxy0" not in left


@pytest.mark.parametrize("before", [(), BOUNDED], ids=["root", "as the unit file has it"])
def test_a53_a_switch_on_the_kernel_plane_opens_ports_that_come_back(
    nodes: LabMachine, space: Space, before: Sequence[str]
) -> None:
    switch = nodes.launch_node("switch", "switch", "--data-plane", "kernel", before=before)
    try:
        nodes.ready(switch)
    except FailedError as error:
        if "data plane kernel" in str(error):
            pytest.skip(f"no kernel data plane here: {error}")
        raise
    assert_fenced(switch, DEVICE | {Capability.BPF, Capability.PERFMON})
    for times in (1, 2):
        space.ip("link", "delete", "p0")
        switch.until_logged("port=p0 up=False", times)
        space.veth("p0", "q0", bytes.fromhex("02000000aa01"), bytes.fromhex("02000000aa02"))
        switch.until_logged("port=p0 up=True", times)
    assert "refused" not in switch.logged
    assert end(switch) == 0


def test_a53_a_revocation_is_read_after_rights_are_given_away(nodes: LabMachine) -> None:
    switch = nodes.start("switch", "switch", "--data-plane", "raw")
    (nodes.folder / "revoked" / "x").write_bytes(b"no statement")
    switch.send(signal.SIGHUP)
    switch.until_logged("revocation not taken")
    assert "Permission denied" not in switch.logged
    assert end(switch) == 0


def test_a52_only_root_reaches_the_metadata_service(space: Space) -> None:
    (script,) = (file for file in placed({}, Setup()) if file.path.endswith("fog-install"))
    rules = [line for line in script.content.decode().splitlines() if line.startswith("ip ")]
    space.ip("link", "add", "p0", "type", "bridge")
    for words in ("addr add 169.254.169.1/24 dev p0", "link set p0 up"):
        subprocess.run(["ip", *words.split()], check=True)

    def reaches(uid: int, port: int) -> bool:
        words = f"ip route get 169.254.169.254 uid {uid} ipproto tcp dport {port}"
        return not subprocess.run(words.split(), capture_output=True, check=False).returncode

    assert reaches(1_000, 80)
    for _ in range(2):  # at each start of the service
        subprocess.run(["sh", "-euc", "\n".join(rules)], check=True)
    assert not reaches(1_000, 80)
    assert not reaches(65_534, 80)
    assert reaches(0, 80)
    assert reaches(1_000, 443)
    shown = subprocess.run(["ip", "rule"], capture_output=True, text=True, check=True).stdout
    assert shown.count("169.254.169.254") == 1


def test_a53_the_sandbox_can_be_left_out(nodes: LabMachine) -> None:
    path = nodes.folder / "switch.yaml"
    path.write_text(path.read_text() + "sandbox: false\n")
    switch = nodes.start("switch", "switch", "--data-plane", "raw")
    assert status_of(switch)["NoNewPrivs"] == "0"
    assert Capability.SYS_ADMIN in capabilities_of(switch)
    assert " rights " not in switch.logged
    assert end(switch) == 0
