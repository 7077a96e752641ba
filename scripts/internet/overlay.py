"""Overlay of a laboratory: a switch on each host, joined by tunnels to borders, and nodes that open sessions there.

I/O. The run's directory holds a folder for each node, with its keys, its configuration and its log. Tunnels need
``/dev/net/tun`` and wireguard-go, or WireGuard in the kernel.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import gdp
from gdp.control.endpoints import Endpoint
from gdp.crypto.certificates import Role
from gdp.links.endpoint_files import RECORD_SUFFIX, own_record, public_candidates
from gdp.stores.files import public, write_all
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import ROOT_CERTIFICATE
from gdp.trust.right import Right
from internet.host import Host
from internet.laboratory import Laboratory
from lab.credentials import grant

LISTEN: Final = 51_820
_ATTACH_S: Final = 60.0
_TLS_PORT: Final = 443
_NODE: Final = "node"
_RIB: Final = "rib"
Yaml = Mapping[str, object]


class Overlay:
    """A domain, whose nodes run on the hosts of a laboratory. ``folder``: of all keys and configuration files."""

    def __init__(self, laboratory: Laboratory) -> None:
        self.folder = laboratory.run.directory
        self._domain, self._owner = self.folder / "domain", self.folder / "owner"
        self._labels: dict[str, str] = {}  # of switches, by name
        make_domain(self._domain, "field")
        make_owner(self._owner)

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
        tunnels = {
            "listen": LISTEN,
            "public": [each.to_text() for each in endpoints],
            "peers": str(peers),
            **({"uplinks": list(uplinks)} if uplinks else {}),
            **(links or {}),
        }
        attach = [f"{_NODE}0", *([f"{_RIB}0"] if is_border else [])]
        host.write(label, identity, attach=attach, links=tunnels, relay=has_relay)
        if has_relay:
            host.write(_relay(host), identity, **self._relay_ends(is_border=is_border, borders=borders))

    def start(self, *hosts: Host) -> None:
        """Start the switches and relays of these hosts; return when all are ready.

        Raises ``FailedError``: one does not start.
        """
        switches = [(each, each.launch_node("switch", each.label)) for each in hosts]
        for host, switch in switches:
            host.ready(switch)
        with_relay = [each for each in hosts if (each.folder / f"{_relay(each)}.yaml").exists()]
        relays = [(each, each.launch_node("relay", _relay(each))) for each in with_relay]
        for host, relay in relays:
            host.ready(relay)

    def start_rib(self, host: Host) -> None:
        """Start the domain's RIB on a border; return when it is ready."""
        identity = self.folder / _RIB
        if not identity.exists():
            make_node(identity, Role.RIB, _RIB, self._domain)
        host.write(_RIB, identity, iface=f"{_RIB}0")
        host.start("rib", _RIB)

    def kill_border(self, border: Host) -> None:
        """Kill a border's switch, its RIB and its relay; ``start`` and ``start_rib`` bring them back."""
        for process in list(border.running):
            border.kill(process)

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

    def tunnels(self, host: Host) -> dict[str, dict[str, Any]]:
        """Return the status of the tunnels of a host's switch, by the label of the peer's host."""
        return {self._labels[row["peer"]]: row for row in self.status(host)["links"]}

    def status(self, host: Host) -> dict[str, Any]:
        """Return the status of a host's switch."""
        return host.status(str(self.switch_folder(host.label)))

    def switch_folder(self, label: str) -> Path:
        """Return the directory of a switch's keys."""
        return self.folder / f"{label}-switch"

    def peers_folder(self, label: str) -> Path:
        """Return the folder with the endpoint records that a switch reads."""
        return self.folder / f"{label}-peers"

    def _relay_ends(self, *, is_border: bool, borders: Sequence[Host]) -> Yaml:
        """Return the keys of a relay's configuration that say what it listens on, or what it dials."""
        if is_border:
            return {"server": {"port": _TLS_PORT}}
        names = {peer: name for name, peer in self._labels.items()}
        dialled = [(names[each.label], each.lease(each.devices[0]).address.partition("/")[0]) for each in borders]
        ends = [{"peer": peer, "endpoints": [Endpoint(own, _TLS_PORT).to_text()]} for peer, own in dialled]
        return {"borders": ends}

    def _copy_record(self, whose: str, to: str) -> None:
        name = f"{whose}{RECORD_SUFFIX}"
        (self.peers_folder(to) / name).write_bytes((self.folder / "records" / name).read_bytes())


def _relay(host: Host) -> str:
    """Return the name of the configuration of a host's relay."""
    return f"{host.label}-relay"
