"""Stage of the demonstration: an internet with four machines, of which three join the domain of the fourth by tokens.

I/O; creates namespaces, keys, files and processes of one run.
::

    robot   wlan0 -- home, port-restricted NAT ----+
            wwan0 -- 5G, symmetric NAT ------------+-- internet -- cloud-b, public: border, RIB, enrolment
    cloud-a ------- provider, port-restricted NAT -+
    edge    ------- office, IPv6 only -------------+

Commands and programs are those that a person or systemd starts on real machines. The ROS proxy of a machine without an
environment of ROS is left out: sessions of this process take its place, with its keys.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import gdp
from gdp.control.endpoints import Endpoint
from gdp.enrolment.member_files import MemberFiles
from gdp.enrolment.member_setup import LISTEN_PORT
from gdp.enrolment.programs import programs_of
from gdp.errors import GdpError
from gdp.management.control_client import ask_node, find_control_socket
from gdp.state.control_protocol import Command
from gdp.stores.issue import make_owner
from gdp.stores.keyring import CARD, load_card
from gdp.trust.right import Right
from internet.access import Access
from internet.host import Host
from internet.laboratory import Laboratory
from internet.site import Site
from lab.credentials import grant
from lab.process import until

WIFI: Final = "wlan0"
WWAN: Final = "wwan0"
_DOMAIN: Final = "lab"
_PATIENCE_S: Final = 60.0
_STATUS_S: Final = 2.0
_SHOWN: Final = 40  # characters of a word


@dataclass(frozen=True, slots=True)
class Machine:
    """A machine of the domain. ``directory``: of its keys and configuration."""

    label: str
    host: Host
    directory: Path


@dataclass(frozen=True, slots=True)
class Link:
    """A tunnel that is up: the machine at its far end, its device, whether it is direct, and where the peer is."""

    peer: str
    device: str
    is_direct: bool
    endpoint: str


class Stage:
    """Networks, and machines with their programs.

    Args:
        delay_ms: of each uplink, in each direction; 0: none, and no process for it.

    Attributes:
        typed: the commands that a person types, each after its machine.
    """

    def __init__(self, laboratory: Laboratory, delay_ms: float) -> None:
        self._laboratory = laboratory
        self._folder = laboratory.run.directory
        self._delay_ms = delay_ms
        self.machines: dict[str, Machine] = {}
        self.typed: list[str] = []
        self.cloud_b = laboratory.add_host("cloud-b", self.add_site("dc", Access.PUBLIC))
        self._add_members()

    def _add_members(self) -> None:
        """Make the machines that join."""
        self.home, self.mobile = self.add_site("home", Access.PORT_RESTRICTED), self.add_site("5g", Access.SYMMETRIC)
        self.robot = self._laboratory.add_host("robot", self.home, WIFI)
        self.robot.attach(self.mobile, WWAN)
        self.cloud_a = self._laboratory.add_host("cloud-a", self.add_site("provider", Access.PORT_RESTRICTED))
        self.edge = self._laboratory.add_host("edge", self.add_site("office", Access.IPV6_ONLY))

    def add_site(self, label: str, access: Access) -> Site:
        """Attach one more network."""
        return self._laboratory.add_site(label, access, delay_ms=self._delay_ms, jitter_ms=self._delay_ms / 10)

    def create_domain(self) -> str:
        """Create the domain on the public machine; return the token for the first machine."""
        lease = self.cloud_b.lease()
        addresses = [each.partition("/")[0] for each in (lease.address, lease.address6)]
        public = [f"--public={Endpoint(each, LISTEN_PORT).to_text()}" for each in addresses]
        return self._command(self.cloud_b, "domain", "create", _DOMAIN, *public).strip()

    def make_token(self) -> str:
        """Return a token for one more machine."""
        return self.type_at(self.cloud_b, "domain", "token", _DOMAIN).strip()

    def type_at(self, host: Host, *words: str) -> str:
        """Run a command of ``gdp`` about a machine on it; return its output."""
        self._typed(host, words)
        return host.gdp(*words, f"--directory={self._directory(host)}")

    def join(self, host: Host, token: str, *options: str) -> None:
        """Let a machine join by a token."""
        self._command(host, "join", f"--label={host.label}", *options, answer=token)

    def remove(self, label: str) -> None:
        """Remove a machine from the domain."""
        self.cloud_b.gdp("domain", "remove", _DOMAIN, label, f"--directory={self._directory(self.cloud_b)}")

    def start(self, *hosts: Host) -> None:
        """Start the programs of machines, as the last step of their commands does; the kernel ends them with us."""
        for host in hosts:
            for program in programs_of(MemberFiles.load(self._directory(host))):
                if program.name != "proxy" or host.environment:
                    host.launch(program.argv, host.label, heard=False)

    def wait_until_joined(self) -> None:
        """Return when each machine has a tunnel to the border. Raises ``FailedError``: one has none in time."""
        for label, machine in self.machines.items():
            until(partial(self.links, machine), partial(self._missing_tunnel, label), _PATIENCE_S)

    def links(self, machine: Machine) -> list[Link]:
        """Return the tunnels of a machine that are up; none while its switch starts."""
        try:
            answer = ask_node(find_control_socket(machine.directory / "switch"), Command.STATUS, _STATUS_S)
        except GdpError:
            return []
        rows = answer.result.get("links", [])
        assert isinstance(rows, list)
        labels = {
            load_card(each.directory / "switch" / CARD).name.to_text(): each.label for each in self.machines.values()
        }
        return [
            Link(labels[row["peer"]], str(row["device"]), bool(row.get("direct")), str(row["endpoint"]))
            for row in rows
            if row["up"] and row["peer"] in labels
        ]

    def grant(self, rights: Mapping[str, Mapping[str, Collection[Right]]]) -> None:
        """Let nodes of machines act on names: by label of the machine, then by name."""
        owner = self._folder / "owner"
        make_owner(owner)
        for label, names in rights.items():
            grant(owner, self.machines[label].directory / "proxy", names)

    def open_session(self, machine: Machine) -> gdp.Session:
        """Open a session of this process on a machine."""
        return machine.host.space.inside(lambda: gdp.open(machine.directory / "proxy"))

    def log(self, label: str) -> str:
        """Return what the programs of a machine have logged."""
        return (self._folder / f"{label}.log").read_text(encoding="utf-8", errors="replace")

    def _missing_tunnel(self, label: str) -> str:
        return f"{self.log(label)[-2_000:]}\na tunnel at {label}"

    def _directory(self, host: Host) -> Path:
        return self._folder / host.label

    def _command(self, host: Host, *words: str, answer: str = "") -> str:
        """Execute a command that makes a machine, without its last step; return its output.

        Args:
            answer: what the command gets when it asks.
        """
        self._typed(host, words)
        directory = self._directory(host)
        said = host.gdp(*words, f"--directory={directory}", "--no-start", answer=answer)
        self.machines[host.label] = Machine(host.label, host, directory)
        return said

    def _typed(self, host: Host, words: Sequence[str]) -> None:
        shown = " ".join(word if len(word) < _SHOWN else f"{word[: _SHOWN - 3]}..." for word in words)
        self.typed.append(f"{host.label}: gdp {shown}")
