"""Overlay of a laboratory: a switch on each host, joined by tunnels to borders, and nodes that open sessions there.

I/O. The run's directory holds a folder for each node, with its keys, its configuration and its log. Tunnels need
``/dev/net/tun`` and wireguard-go, or WireGuard in the kernel.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Final

import yaml

import gdp
from gdp.control.endpoints import Endpoint
from gdp.crypto.certificates import Role
from gdp.links.endpoint_files import RECORD_SUFFIX, own_record, public_candidates
from gdp.management.control_client import ask_node, find_control_socket
from gdp.state.control_protocol import Command
from gdp.stores.files import public, write_all
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import ROOT_CERTIFICATE
from gdp.trust.right import Right
from internet.host import Host
from internet.laboratory import Laboratory
from lab.credentials import grant
from lab.process import LabProcess, end_processes

LISTEN: Final = 51_820
_PATIENCE_S: Final = 5.0
_START_S: Final = 60.0
_ATTACH_S: Final = 60.0
_RELAY: Final = "relay"
_TLS_PORT: Final = 443
_NODE: Final = "node"
_RIB: Final = "rib"
Yaml = Mapping[str, object]


class Overlay:
    """Processes of a domain; a context manager that ends them. ``folder``: of all keys and configuration files."""

    def __init__(self, laboratory: Laboratory) -> None:
        self.folder = laboratory.run.directory
        self._laboratory = laboratory
        self._domain, self._owner = self.folder / "domain", self.folder / "owner"
        self._processes: dict[str, LabProcess] = {}
        self._labels: dict[str, str] = {}  # of switches, by name
        make_domain(self._domain, "field")
        make_owner(self._owner)

    def __enter__(self) -> Overlay:
        return self

    def __exit__(self, *_: object) -> None:
        self.end(*self._processes)

    def add_switch(
        self,
        host: Host,
        *,
        is_border: bool = False,
        borders: Sequence[Host] = (),
        has_relay: bool = False,
        uplinks: Sequence[str] = (),
        links: Yaml | None = None,
    ) -> None:
        """Make the keys and the configuration of a host's switch, which ``start`` starts.

        Args:
            is_border: others dial its public addresses.
            borders: to which it opens a tunnel. Each gets a record of this switch.
            has_relay: whether a relay runs next to it: the server of a border, or on standby towards the borders.
            uplinks: devices with a tunnel each to every border; none: one tunnel, over the best route.
            links: more keys of ``links:``.
        """
        label = host.label
        identity = self.switch_folder(label)
        made = make_node(identity, Role.SWITCH, label, self._domain)
        self._labels[made.name.to_text()] = label
        peers = self.peers_folder(label)
        peers.mkdir()
        lease = host.lease(host.devices[0])
        own = [Endpoint(address.partition("/")[0], LISTEN) for address in (lease.address, lease.address6) if address]
        endpoints = own if is_border else []
        record = own_record(made, max(len(uplinks), 1), public_candidates(endpoints))
        write_all(self.folder / "records", {f"{label}{RECORD_SUFFIX}": public(record.wire)}, force=True)
        for one, other in ((label, border.label) for border in borders):
            self._copy_record(one, other)
            self._copy_record(other, one)
        content = {
            "identity": str(identity),
            "domain": self._root(),
            "attach": [f"{_NODE}0", *([f"{_RIB}0"] if is_border else [])],
            "links": {
                "listen": LISTEN,
                "public": [each.to_text() for each in endpoints],
                "peers": str(peers),
                **({"uplinks": list(uplinks)} if uplinks else {}),
                **(links or {}),
            },
            "relay": has_relay,
        }
        self.config_file(label).write_text(yaml.safe_dump(content), encoding="utf-8")
        if has_relay:
            self._write_relay(label, is_border=is_border, borders=borders)

    def start(self, *hosts: Host) -> None:
        """Start the switches and relays of these hosts; return when all are ready.

        Raises ``FailedError``: one does not start.
        """
        self._start({host.label: (host, "gdp.cli.switch", self.config_file(host.label)) for host in hosts})
        relays = {f"{host.label}-{_RELAY}": host for host in hosts}
        found = {label: (host, "gdp.cli.relay", self.config_file(label)) for label, host in relays.items()}
        self._start({label: each for label, each in found.items() if each[2].exists()})

    def start_rib(self, host: Host) -> None:
        """Start the domain's RIB on a border; return when it is ready."""
        identity = self.folder / _RIB
        if not identity.exists():
            make_node(identity, Role.RIB, _RIB, self._domain)
        path = self.folder / f"{_RIB}.yaml"
        content = {"identity": str(identity), "domain": self._root(), "iface": f"{_RIB}0"}
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        self._start({_RIB: (host, "gdp.cli.rib", path)})

    def end(self, *labels: str) -> None:
        """End the switches of these hosts, or the RIB, at once."""
        end_processes([self._processes.pop(label) for label in labels], _PATIENCE_S)

    def kill_border(self, border: Host) -> None:
        """Kill a border's switch, its RIB and its relay; ``start`` and ``start_rib`` bring them back."""
        labels = {border.label, f"{border.label}-{_RELAY}", _RIB} & self._processes.keys()
        for process in [self._processes.pop(label) for label in labels]:
            process.kill_group()

    def add_node(self, host: Host, rights: Mapping[str, Collection[Right]]) -> Path:
        """Make the keys of the host's node, with rights on names; return its directory."""
        node = self.folder / f"{host.label}-{_NODE}"
        make_node(node, Role.PROXY, node.name, self._domain)
        grant(self._owner, node, rights)
        return node

    def open_session(self, host: Host, node: Path, lease_s: float | None = None) -> gdp.Session:
        """Open a session of this process at the host's switch, which may still have to find a way to the RIB."""
        root, iface = self._domain / ROOT_CERTIFICATE, f"{_NODE}0"
        return host.space.inside(lambda: gdp.open(node, iface=iface, root=root, timeout_s=_ATTACH_S, lease_s=lease_s))

    def tunnels(self, host: Host) -> dict[str, dict[str, object]]:
        """Return the status of the tunnels of a host's switch, by the label of the peer's host."""
        rows = self.status(host)["links"]
        assert isinstance(rows, list)
        return {self._labels[str(row["peer"])]: row for row in rows}

    def status(self, host: Host) -> Mapping[str, object]:
        """Return the status of a host's switch."""
        return ask_node(find_control_socket(self.switch_folder(host.label)), Command.STATUS, _PATIENCE_S).result

    def switch_folder(self, label: str) -> Path:
        """Return the directory of a switch's keys."""
        return self.folder / f"{label}-switch"

    def peers_folder(self, label: str) -> Path:
        """Return the folder with the endpoint records that a switch reads."""
        return self.folder / f"{label}-peers"

    def config_file(self, label: str) -> Path:
        """Return the configuration file of a host's switch, or of another program by its label."""
        return self.folder / f"{label}.yaml"

    def log(self, label: str) -> str:
        """Return what a process has logged."""
        return (self.folder / f"{label}.log").read_text(encoding="utf-8")

    def _write_relay(self, label: str, *, is_border: bool, borders: Sequence[Host]) -> None:
        ends: Yaml = {"server": {"port": _TLS_PORT}}
        if not is_border:
            names = {peer: name for name, peer in self._labels.items()}
            dialled = [(names[each.label], each.lease(each.devices[0])) for each in borders]
            ends = {
                "borders": [
                    {"peer": name, "endpoints": [Endpoint(lease.address.partition("/")[0], _TLS_PORT).to_text()]}
                    for name, lease in dialled
                ]
            }
        content = {"identity": str(self.switch_folder(label)), "domain": self._root(), **ends}
        self.config_file(f"{label}-{_RELAY}").write_text(yaml.safe_dump(content), encoding="utf-8")

    def _copy_record(self, whose: str, to: str) -> None:
        name = f"{whose}{RECORD_SUFFIX}"
        (self.peers_folder(to) / name).write_bytes((self.folder / "records" / name).read_bytes())

    def _root(self) -> Yaml:
        return {"root": str(self._domain / ROOT_CERTIFICATE)}

    def _start(self, commands: Mapping[str, tuple[Host, str, Path]]) -> None:
        for label, (host, module, config) in commands.items():
            argv = host.command([sys.executable, "-m", module, "--json", "--config", str(config)])
            self._processes[label] = LabProcess(self._laboratory.run, label, argv)
        for label in commands:
            if self._processes[label].read(_START_S).get("event") != "ready":
                raise self._processes[label].failed("does not start")
