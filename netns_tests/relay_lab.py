"""Border and member that only a routed IPv4 cable joins, with the files and processes of relays and switches."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from gdp.crypto.certificates import Role
from gdp.management.control_client import ask_node
from gdp.names import Name
from gdp.ports.tap import tap_name
from gdp.state.control_protocol import Command
from gdp.stores.issue import make_domain, make_node
from gdp.stores.keyring import load_card
from lab.process import LabProcess, end_processes
from netns_tests.cable import sim_link
from netns_tests.spaces import Space
from tests.waiting import until

PORT = 443
BORDER_ADDRESS, MEMBER_ADDRESS, LATER_ADDRESS = "192.0.2.1", "192.0.2.2", "192.0.2.3"
_PATIENCE_S = 60.0


class Node:
    """One machine: a folder, a namespace, which ``enter`` leads into, and its processes."""

    def __init__(self, home: Path, label: str, enter: list[str]) -> None:
        self.home, self.label, self.enter = home, label, enter
        self.running: list[LabProcess] = []
        self.identity = home / label
        self.name: Name = load_card(self.identity / "node.card").name

    def ip(self, *words: str) -> None:
        """Run ``ip`` here."""
        subprocess.run([*self.enter, "ip", *words], check=True, capture_output=True)

    def links(self) -> list[dict[str, Any]]:
        """Return the devices as ``ip -j`` describes them."""
        done = subprocess.run([*self.enter, "ip", "-j", "link", "show"], check=True, capture_output=True)
        found: list[dict[str, Any]] = json.loads(done.stdout)
        return found

    def devices(self) -> set[str]:
        """Return the names of the devices."""
        return {str(each["ifname"]) for each in self.links()}

    def kill(self, process: LabProcess) -> None:
        """End a process at once, as the kernel does when memory is short."""
        self.running.remove(process)
        process.kill_group()

    def run(self, *argv: str) -> subprocess.CompletedProcess[str]:
        """Run a command here, in the folder of all files; it ends by itself."""
        return subprocess.run(
            [*self.enter, *argv],
            cwd=self.home,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=False,
        )

    def write(self, file: str, **keys: object) -> Path:
        """Write a configuration of this machine's identity."""
        path = self.home / f"{self.label}-{file}"
        domain = {"root": f"{self.label}/root.crt"}
        path.write_text(yaml.safe_dump({"identity": self.label, "domain": domain, **keys}))
        return path

    def start(self, module: str, config: Path, *words: str) -> LabProcess:
        """Start a node, and return when it is ready."""
        argv = [*self.enter, sys.executable, "-m", module, "--config", str(config), "--json", *words]
        process = LabProcess(None, self.label, argv, log=self.home / f"{self.label}-{module}.log")
        self.running.append(process)
        assert process.read(_PATIENCE_S)["event"] == "ready", self.log(module)
        return process

    def log(self, module: str) -> str:
        """Return what the node logged so far."""
        return (self.home / f"{self.label}-{module}.log").read_text()

    def status(self, socket: Path) -> dict[str, Any]:
        """Return the status over a control socket."""
        return dict(ask_node(socket, Command.STATUS, _PATIENCE_S).result)

    def end(self) -> None:
        """End all processes, at last with a kill."""
        end_processes(self.running, 10.0)
        self.running.clear()


class RelayLab:
    """The two machines."""

    def __init__(self, home: Path, into_member: list[str]) -> None:
        self.home, self.domain = home, home / "domain"
        make_domain(self.domain, "lab", unix_s=time.time() - 30 * 86_400)
        for label in ("border", "member"):
            make_node(home / label, Role.SWITCH, label, self.domain, days=30, unix_s=time.time())
        self.border, self.member = Node(home, "border", []), Node(home, "member", into_member)
        self.member_device = tap_name(self.member.name, self.border.name)

    def relay_config(self, node: Node, *, standby: bool = False, **more: object) -> Path:
        """Write ``relay.yaml`` of one machine."""
        endpoints = [f"{BORDER_ADDRESS}:{PORT}"]
        border = {"peer": self.border.name.to_text(), "endpoints": endpoints, "standby": standby}
        part: dict[str, object] = {"server": {"port": PORT}} if node is self.border else {"borders": [border]}
        return node.write("relay.yaml", control_socket=f"{node.label}-relay.sock", **{**part, **more})

    def start_relay(self, node: Node, *, standby: bool = False, **more: object) -> LabProcess:
        """Start the relay of one machine."""
        return node.start("gdp.cli.relay", self.relay_config(node, standby=standby, **more))

    def start_relays(self) -> tuple[LabProcess, LabProcess]:
        """Start both relays; return border's and member's when frames may pass."""
        processes = self.start_relay(self.border), self.start_relay(self.member)
        until(self.is_up)
        return processes

    def start_switch(self, node: Node, **more: object) -> LabProcess:
        """Start the switch of one machine; its only links are the relay's devices."""
        socket = f"{node.label}-switch.sock"
        config = node.write("switch.yaml", relay=True, control_socket=socket, data_plane="raw", **more)
        return node.start("gdp.cli.switch", config)

    def link_peers(self) -> None:
        """Write the endpoint record of each machine for the other, so that a tunnel over UDP can join them."""
        for node, other in ((self.border, self.member), (self.member, self.border)):
            (self.home / f"{node.label}-peers").mkdir()
            record = self.home / f"{node.label}-peers/{other.label}.endpoints"
            where = ["--public", f"{BORDER_ADDRESS}:51820"] if other is self.border else []
            done = node.run(sys.executable, "-m", "gdp.cli.gdp", "endpoints", other.label, *where, "-o", str(record))
            assert done.returncode == 0, done.stderr

    def tunnel_is_up(self) -> bool:
        """Return whether the member's switch has its border as a neighbour over UDP."""
        links = self.member.status(self.home / "member-switch.sock")["links"]
        return bool(links and links[0]["up"])

    def neighbours(self, node: Node) -> int:
        """Return how many neighbours the switch of a machine has."""
        return int(node.status(self.home / f"{node.label}-switch.sock")["neighbours"])

    def relay_status(self, node: Node) -> dict[str, Any]:
        """Return the status of the relay of a machine."""
        return node.status(self.home / f"{node.label}-relay.sock")

    def is_up(self) -> bool:
        """Return whether the member's relay is connected."""
        return bool(self.relay_status(self.member)["borders"][0]["state"] == "up")

    def is_joined(self) -> bool:
        """Return whether both switches see each other."""
        return self.neighbours(self.border) == self.neighbours(self.member) == 1


@contextmanager
def relay_lab(space: Space, home: Path) -> Iterator[RelayLab]:
    """Yield a border in this namespace and a member in another one."""
    with sim_link(space) as enter:
        lab = RelayLab(home, enter)
        try:
            for node, address in ((lab.border, BORDER_ADDRESS), (lab.member, MEMBER_ADDRESS)):
                node.ip("addr", "add", f"{address}/24", "dev", "eth0")
            yield lab
        finally:
            lab.member.end()
            lab.border.end()
