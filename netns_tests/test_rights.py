"""Privileges of the real commands after their start: the kernel's view, and that later operations still work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from fog.providers.cloud_init import Setup, placed
from gdp.crypto.certificates import Role
from gdp.metadata import Metadata
from gdp.ports.confine import landlock
from gdp.ports.sandbox import Capability
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, DELEGATIONS
from gdp.trust.right import Right
from netns_tests.spaces import Space
from tests.pages import ROOT

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about rights of processes, no lease matters"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root has capabilities to give away"),
]

PATIENCE_S = 60.0
DEVICE = {Capability.NET_ADMIN, Capability.NET_RAW}
BOUNDED = ("setpriv", "--bounding-set=-all,+net_raw,+net_admin,+bpf,+perfmon,+setpcap", "--")
FILES = {
    "switch.yaml": "identity: switch\ndomain: {root: switch/root.crt}\nports: [{iface: p0}]\nattach: [rib0, proxy0]\n"
    "revocations: revoked\nmetrics: {port: 9471}\n",
    "rib.yaml": "identity: rib\ndomain: {root: rib/root.crt}\niface: rib0\nsnapshot: kept/routes\n",
    "proxy.yaml": "identity: proxy\ndomain: {root: proxy/root.crt}\niface: proxy0\ndelegations: proxy/delegations\n"
    "record: {path: kept/received.mcap}\nimport:\n- {name: /a, type: std_msgs/msg/Empty, owner: owner/owner.pub}\n",
}


@dataclass
class Node:
    """Running command."""

    process: subprocess.Popen[bytes]
    log: Path

    @property
    def status(self) -> dict[str, str]:
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}

    @property
    def capabilities(self) -> set[int]:
        mask = int(self.status["CapEff"], 16)
        return {number for number in range(64) if mask >> number & 1}

    def until(self, text: str, times: int = 1) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while self.log.read_text().count(text) < times:
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < end_s, self.log.read_text()
            time.sleep(0.05)

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(PATIENCE_S)


class Commands:
    """Commands of one folder, in the namespace of the test."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.nodes: list[Node] = []

    def start(self, module: str, name: str, *more: str, before: Sequence[str] = ()) -> Node:
        log = self.home / f"{name}.log"
        words = [*before, sys.executable, "-m", module, "--config", str(self.home / f"{name}.yaml"), "--json", *more]
        with log.open("wb") as file:
            process = subprocess.Popen(
                words, stdout=file, stderr=file, env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=self.home
            )
        node = Node(process, log)
        self.nodes.append(node)
        return node


@pytest.fixture
def commands(space: Space, tmp_path: Path) -> Iterator[Commands]:
    """Files of a switch, a RIB and a recording proxy; a link p0 to q0."""
    make_domain(tmp_path / "lab", "lab")
    make_owner(tmp_path / "owner")
    for role in (Role.SWITCH, Role.RIB, Role.PROXY):
        make_node(tmp_path / role.value, role, "lab", tmp_path / "lab")
    metadata = Metadata({"kind": "topic", "name": "/a", "type": "std_msgs/msg/Empty"})
    (tmp_path / "proxy" / DELEGATIONS).mkdir()
    given = delegate(tmp_path / "owner", tmp_path / "proxy" / CARD, metadata, [Right.READ])
    install_delegation(tmp_path / "proxy", given)
    for folder in ("kept", "revoked"):
        (tmp_path / folder).mkdir()
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    space.veth("p0", "q0", bytes.fromhex("02000000aa01"), bytes.fromhex("02000000aa02"))
    made = Commands(tmp_path)
    yield made
    for node in made.nodes:
        node.process.kill()
        node.process.wait()


def assert_fenced(node: Node, kept: set[Capability]) -> None:
    node.until(" rights ")
    status = node.status
    assert node.capabilities == kept
    assert int(status["CapBnd"], 16) == 0
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    assert f"landlock={landlock.abi() or 'none'}" in node.log.read_text()
    threads = [task / "status" for task in Path(f"/proc/{node.process.pid}/task").iterdir()]
    assert all(f"CapEff:\t{status['CapEff']}\n" in each.read_text() for each in threads)


def test_a53_commands_that_are_up_keep_only_what_they_need(commands: Commands, space: Space) -> None:
    switch = commands.start("gdp.cli.switch", "switch", "--data-plane", "raw")
    switch.until('"ready"')
    rib = commands.start("gdp.cli.rib", "rib", "--await-iface", "30")
    proxy = commands.start("proxy.cli.proxy", "proxy", "--await-iface", "30")
    for node in (rib, proxy):
        node.until('"ready"')
    for node in (switch, rib, proxy):
        assert_fenced(node, DEVICE)
    space.ip("delete", "p0")
    switch.until("port=p0 up=False")
    space.veth("p0", "q0", bytes.fromhex("02000000aa01"), bytes.fromhex("02000000aa02"))
    switch.until("port=p0 up=True")
    switch.process.send_signal(signal.SIGHUP)
    assert [proxy.end(), rib.end(), switch.end()] == [0, 0, 0]
    assert {path.name for path in (commands.home / "kept").iterdir()} == {"received.mcap", "routes"}
    left = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
    assert "rib0" not in left
    assert "proxy0" not in left


@pytest.mark.parametrize("before", [(), BOUNDED], ids=["root", "as the unit file has it"])
def test_a53_a_switch_on_the_kernel_plane_opens_ports_that_come_back(
    commands: Commands, space: Space, before: Sequence[str]
) -> None:
    switch = commands.start("gdp.cli.switch", "switch", "--data-plane", "kernel", before=before)
    end_s = time.monotonic() + PATIENCE_S
    while '"ready"' not in switch.log.read_text():
        if switch.process.poll() is not None and "data plane kernel" in switch.log.read_text():
            pytest.skip(f"no kernel data plane here: {switch.log.read_text().splitlines()[-1]}")
        assert time.monotonic() < end_s
        time.sleep(0.05)
    assert_fenced(switch, DEVICE | {Capability.BPF, Capability.PERFMON})
    for times in (1, 2):
        space.ip("delete", "p0")
        switch.until("port=p0 up=False", times)
        space.veth("p0", "q0", bytes.fromhex("02000000aa01"), bytes.fromhex("02000000aa02"))
        switch.until("port=p0 up=True", times)
    assert "refused" not in switch.log.read_text()
    assert switch.end() == 0


def test_a53_a_revocation_is_read_after_rights_are_given_away(commands: Commands) -> None:
    switch = commands.start("gdp.cli.switch", "switch", "--data-plane", "raw")
    switch.until('"ready"')
    (commands.home / "revoked" / "x").write_bytes(b"no statement")
    switch.process.send_signal(signal.SIGHUP)
    switch.until("revocation not taken")
    assert "Permission denied" not in switch.log.read_text()
    assert switch.end() == 0


def test_a52_only_root_reaches_the_metadata_service(space: Space) -> None:
    (script,) = (file for file in placed({}, Setup()) if file.path.endswith("fog-install"))
    rules = [line for line in script.content.decode().splitlines() if line.startswith("ip ")]
    space.ip("add", "p0", "type", "bridge")
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


def test_a53_the_sandbox_can_be_left_out(commands: Commands) -> None:
    path = commands.home / "switch.yaml"
    path.write_text(path.read_text() + "sandbox: false\n")
    switch = commands.start("gdp.cli.switch", "switch", "--data-plane", "raw")
    switch.until('"ready"')
    assert switch.status["NoNewPrivs"] == "0"
    assert Capability.SYS_ADMIN in switch.capabilities
    assert " rights " not in switch.log.read_text()
    assert switch.end() == 0
