"""Overlay of a laboratory: a domain that one host creates and others join by tokens, with the commands of a person.

I/O; creates keys, files and processes of one run. Commands and programs are those that a person or systemd starts on
real machines. The ROS proxy of a machine without an environment of ROS is left out: sessions of this process take its
place, with its keys. Tunnels need ``/dev/net/tun`` and wireguard-go, or WireGuard in the kernel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import yaml

import gdp
from gdp.control.endpoints import Endpoint
from gdp.enrolment.member_files import MemberFiles
from gdp.enrolment.member_setup import LISTEN_PORT
from gdp.enrolment.programs import programs_of
from gdp.errors import GdpError
from gdp.stores.issue import make_owner
from gdp.stores.keyring import CARD, load_card
from internet.host import Host
from internet.laboratory import Laboratory
from lab.credentials import NameRights, grant
from lab.process import until

_DOMAIN: Final = "lab"
_PATIENCE_S: Final = 60.0
_SHOWN: Final = 40  # characters of a word


@dataclass(frozen=True, slots=True)
class Link:
    """A tunnel that is up: the machine at its far end, its device, whether it is direct, and where the peer is."""

    peer: str
    device: str
    is_direct: bool
    endpoint: str


class Overlay:
    """A domain, and its machines with their programs.

    Args:
        border: creates the domain; the others dial its public addresses.
        links: more keys of ``links:`` of every switch.

    Attributes:
        machines: those that belong to the domain, by label.
        typed: the commands that a person types, each after its machine.
    """

    def __init__(self, laboratory: Laboratory, border: Host, links: Mapping[str, object] | None = None) -> None:
        self._folder = laboratory.run.directory
        self._links = links or {}
        self.border = border
        self.machines: dict[str, Host] = {}
        self.typed: list[str] = []
        self._owner = self._folder / "owner"
        make_owner(self._owner)

    def create_domain(self) -> str:
        """Create the domain on the border; return the token for the first machine."""
        lease = self.border.lease()
        addresses = [each.partition("/")[0] for each in (lease.address, lease.address6)]
        public = [f"--public={Endpoint(each, LISTEN_PORT).to_text()}" for each in addresses]
        return self._command(self.border, "domain", "create", _DOMAIN, *public).strip()

    def make_token(self) -> str:
        """Return a token for one more machine."""
        return self.type_at(self.border, "domain", "token", _DOMAIN).strip()

    def type_at(self, host: Host, *words: str) -> str:
        """Run a command of ``gdp`` about a machine on it; return its output."""
        self._typed(host, words)
        return host.gdp(*words, f"--directory={self.directory(host)}")

    def join(self, host: Host, token: str, *options: str) -> None:
        """Let a machine join by a token."""
        self._command(host, "join", f"--label={host.label}", *options, answer=token)

    def stand_up(self, *hosts: Host, options: Mapping[str, Sequence[str]] | None = None) -> None:
        """Create the domain, let hosts join at once, and start all programs.

        ``options``: more words of ``gdp join``, by label.
        """
        first = self.create_domain()
        self.start(self.border)
        tokens = [first, *(self.make_token() for _ in hosts[1:])]
        more = [(options or {}).get(host.label, ()) for host in hosts]
        with ThreadPoolExecutor(len(hosts)) as pool:
            list(pool.map(lambda host, token, words: self.join(host, token, *words), hosts, tokens, more))
        self.start(*hosts)

    def remove(self, label: str) -> None:
        """Remove a machine from the domain."""
        self.border.gdp("domain", "remove", _DOMAIN, label, f"--directory={self.directory(self.border)}")

    def start(self, *hosts: Host) -> None:
        """Start the programs of machines, as the last step of their commands does; return when each switch answers."""
        for host in hosts:
            for program in programs_of(MemberFiles.load(self.directory(host))):
                if program.name != "proxy" or host.environment:
                    host.launch(program.argv, host.label, heard=False)
        for host in hosts:
            until(partial(self._answers, host), partial(self._log_and, host.label, "a switch"), _PATIENCE_S)

    def kill(self, host: Host) -> None:
        """Kill all programs of a machine; ``start`` brings them back."""
        for process in list(host.running):
            host.kill(process)

    def wait_until_joined(self) -> None:
        """Return when each machine has a tunnel to the border. Raises ``FailedError``: one has none in time."""
        for label, host in self.machines.items():
            until(partial(self.links, host), partial(self._log_and, label, "a tunnel"), _PATIENCE_S)

    def status(self, host: Host) -> dict[str, Any]:
        """Return the status of a machine's switch. Raises ``GdpError``: it does not answer."""
        return host.status(str(self.directory(host) / "switch"))

    def tunnels(self, host: Host) -> dict[str, dict[str, Any]]:
        """Return the status of the tunnels of a machine's switch, by the label of the peer."""
        return {peer: row for peer, row in self._rows(host) if peer}

    def links(self, host: Host) -> list[Link]:
        """Return the tunnels of a machine that are up; none while its switch starts."""
        with suppress(GdpError):
            return [
                Link(peer, str(row["device"]), bool(row.get("direct")), str(row["endpoint"]))
                for peer, row in self._rows(host)
                if peer and row["up"]
            ]
        return []

    def grant(self, rights: Mapping[str, NameRights]) -> None:
        """Let nodes of machines act on names: by label of the machine, then by name."""
        for label, names in rights.items():
            grant(self._owner, self.directory(self.machines[label]) / "proxy", names)

    def open_session(self, host: Host, lease_s: float | None = None) -> gdp.Session:
        """Open a session of this process on a machine; ``lease_s``: of its names."""
        node = self.directory(host) / "proxy"
        return host.space.inside(lambda: gdp.open(node, timeout_s=_PATIENCE_S, lease_s=lease_s))

    def directory(self, host: Host) -> Path:
        """Return the directory of a machine's keys and configuration."""
        return self._folder / host.label

    def extend(self, host: Host, program: str, **keys: object) -> None:
        """Write more keys into the configuration of a machine's program; those of a section that is there extend it."""
        file = self.directory(host) / f"{program}.yaml"
        content = yaml.safe_load(file.read_text())
        for key, value in keys.items():
            held = content.get(key)
            content[key] = {**held, **value} if isinstance(held, dict) and isinstance(value, Mapping) else value
        file.write_text(yaml.safe_dump(content))

    def _rows(self, host: Host) -> list[tuple[str, dict[str, Any]]]:
        """Return the tunnels of a machine's switch, each with the label of its peer; empty: of no machine here."""
        joined = list(self.machines.values())  # others may join meanwhile
        names = {load_card(self.directory(each) / "switch" / CARD).name.to_text(): each.label for each in joined}
        rows = self.status(host).get("links", [])
        return [(names.get(row["peer"], ""), row) for row in rows]

    def _answers(self, host: Host) -> bool:
        with suppress(GdpError):
            return bool(self.status(host))
        return False

    def _log_and(self, label: str, what: str) -> str:
        log = (self._folder / f"{label}.log").read_text(encoding="utf-8", errors="replace")
        return f"{log[-2_000:]}\n{what} at {label}"

    def _command(self, host: Host, *words: str, answer: str = "") -> str:
        """Execute a command that makes a machine, without its last step; return its output.

        ``answer``: what the command gets when it asks.
        """
        self._typed(host, words)
        said = host.gdp(*words, f"--directory={self.directory(host)}", "--no-start", answer=answer)
        if self._links:
            self.extend(host, "switch", links=self._links)
        self.machines[host.label] = host
        return said

    def _typed(self, host: Host, words: Sequence[str]) -> None:
        shown = " ".join(word if len(word) < _SHOWN else f"{word[: _SHOWN - 3]}..." for word in words)
        self.typed.append(f"{host.label}: gdp {shown}")
