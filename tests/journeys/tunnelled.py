"""Machines behind NATs and a border in a simulation: the links of real switches over a model of WireGuard and NATs.

``TunnelLinks``, ``Tunnels`` and ``OwnEndpoints`` are those of the product. A device of the model sends to the endpoint
that it was given, or to where the last packet of the peer came from, through the NATs of ``tests.gdp.switch.nat``. Two
devices begin a session only with equal preshared keys. A machine whose network blocks UDP has the link of a relay
instead.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Final, cast
from unittest import mock

from gdp.config.config import LinksConfig
from gdp.control.endpoints import Endpoint
from gdp.control.preshared_key import NO_KEY
from gdp.control.tunnel_plan import TunnelId, tunnel_ifname
from gdp.crypto.tunnel_key import TunnelKey
from gdp.intervals import PACE_S
from gdp.links.endpoint_files import RECORD_SUFFIX, own_record, public_candidates
from gdp.links.links import TunnelLinks
from gdp.ports.tunnel.control import PeerState
from gdp.ports.tunnel.wireguard import WireGuardDevice
from gdp.runtime.runtime import Runtime
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Topology
from tests.gdp.switch.nat import Gateway, Nat
from tests.journeys.flows import LEASE_S

BORDER: Final = "border"
SITES: Final = ("a", "b", "c")
DELAY_S: Final = 0.02
COST, RELAY_COST = 10, 1_000
LISTEN: Final = 51_820
_PUBLIC: Final = Endpoint("203.0.113.1", LISTEN)
_REKEY_AFTER_S, _REJECT_AFTER_S = 120.0, 180.0  # of a session; WireGuard's whitepaper, section 6.1


@dataclass(slots=True)
class TunnelLink(SimLink):
    """Link whose frames travel as packets through NATs; ``passes`` gets the address of the receiver."""

    passes: Callable[[bytes], bool] = lambda _: False

    def loses(self, to: bytes, chance: float) -> bool:
        """Return whether no packet comes through."""
        del chance
        return not self.passes(to)


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """Session of WireGuard between two devices, which both hold."""

    made_s: float


@dataclass(slots=True)
class Device:
    """WireGuard device of one process of a switch."""

    machine: Machine
    ifname: str = "wg"
    backend: str = "model"
    fwmark: int = 0
    is_ended: bool = False
    endpoints: dict[bytes, Endpoint | None] = field(default_factory=dict)  # by public key of the peer
    heard_unix_s: dict[bytes, float] = field(default_factory=dict)  # first packet since the peer was made
    preshared: dict[bytes, bytes] = field(default_factory=dict)
    sessions: dict[bytes, Session] = field(default_factory=dict)

    @property
    def listen_port(self) -> int:
        return self.machine.gateway.socket

    def set_peer(self, key: bytes, *, endpoint: Endpoint | None, **_: object) -> None:
        self.endpoints[key] = endpoint or self.endpoints.get(key)

    def set_preshared_key(self, public_key: bytes, preshared_key: bytes) -> bool:
        is_new = public_key in self.endpoints and self.preshared.get(public_key, NO_KEY) != preshared_key
        if is_new:
            self.preshared[public_key] = preshared_key
        return is_new

    def remove_peer(self, key: bytes) -> None:
        for known in (self.endpoints, self.heard_unix_s, self.preshared, self.sessions):
            known.pop(key, None)

    def retry_handshake(self, key: bytes) -> None:
        """Hellos follow by themselves."""

    def rebind(self) -> None:
        """Send from another port, each second time from the first one, as ``WireGuardDevice`` does."""
        self.machine.rebind()

    def peers(self) -> dict[bytes, PeerState]:
        return {key: PeerState(at, self.heard_unix_s.get(key, 0.0), 0, 0) for key, at in self.endpoints.items()}

    known_peers = peers

    def poll(self) -> bool:
        return False

    def poll_move(self) -> bool:
        return False

    def path_mtu(self, _: bytes) -> int:
        return 1_500

    def set_mtu(self, _: int) -> None:
        """The links of the simulation have an MTU of their own."""


@dataclass(slots=True)
class Machine:
    """A switch with its NAT."""

    label: str
    gateway: Gateway
    key: bytes
    device: Device = field(init=False)
    links: TunnelLinks | None = None
    rebinds: int = 0
    open_to: set[str] = field(default_factory=set)  # machines towards which it has a port

    def __post_init__(self) -> None:
        self.device = Device(self)

    def rebind(self) -> None:
        self.rebinds += 1
        self.gateway.socket = LISTEN + self.rebinds if self.gateway.socket == LISTEN else LISTEN


class Tunnelled:
    """Three machines, a border with a RIB, and a second RIB; ``tunnelled`` makes it.

    Args:
        nats: of the machines; None: UDP is blocked, so that a relay carries all frames.
        other_rib: where the second RIB is.
        leaves: machines that carry no transit.
    """

    def __init__(
        self, folder: Path, nats: Mapping[str, Nat | None], other_rib: str, leaves: Collection[str], seed: int
    ) -> None:
        self.nats, self.folder = nats, folder
        members = [Attachment(each, "proxy", "member") for each in nats]
        ribs = [Attachment(BORDER, "rib", "rib0"), Attachment(other_rib, "rib", "rib1")]
        self.topology = Topology((), (DomainPlan("lab", (BORDER, *nats)),), (*ribs, *members))
        self.world = Simulation(topology=self.topology, lease_s=LEASE_S, leaves=leaves, seed=seed)
        self.network = self.world.network
        self.machines: dict[str, Machine] = {}
        self.links: dict[frozenset[str], TunnelLink] = {}
        self.relays: list[SimLink] = []
        self.dead: set[str] = set()

    def begin(self) -> None:
        """Start the links of all machines, and wait until all members are attached and all possible tunnels up."""
        for number, label in enumerate((BORDER, *self.nats), 1):
            nat = Nat.NONE if label == BORDER else self.nats[label]
            if nat is None:
                self.relays.append(self.network.connect(label, BORDER, SimLink(DELAY_S), cost=RELAY_COST))
                continue
            address = _PUBLIC.address if label == BORDER else f"198.51.100.{number}"
            key = TunnelKey.derive(self.world.identities[label].kem).public
            self.machines[label] = Machine(label, Gateway(nat, address), key)
        for label in self.machines:
            self._write_records(label)
            self._start(label)
        assert self.world.run_until_attached(30.0)

    def _write_records(self, label: str) -> None:
        folder = self.folder / label
        folder.mkdir()
        for peer in self.machines:
            if (peer == BORDER) is not (label == BORDER):
                record = own_record(self.world.identities[peer], 1, public_candidates(self._public(peer)))
                (folder / f"{peer}{RECORD_SUFFIX}").write_bytes(record.wire)

    @staticmethod
    def _public(label: str) -> tuple[Endpoint, ...]:
        return (_PUBLIC,) if label == BORDER else ()

    def _start(self, label: str) -> None:
        """Start the tunnels of a machine's switch, which has just started itself."""
        machine = self.machines[label]
        machine.device, machine.open_to = Device(machine), set()
        links = machine.links = TunnelLinks(
            config=LinksConfig(peers=self.folder / label, public=tuple(each.to_text() for each in self._public(label))),
            identity=self.world.identities[label],
            policy=self.world.policy("lab"),
            switch=self.world.switches[label],
            runtime=cast("Runtime", Loop(self, label)),
            underlays=(cast("WireGuardDevice", machine.device),),
        )
        self.network.call(0.0, partial(self._look, machine, links))

    def _look(self, machine: Machine, links: TunnelLinks) -> None:
        if machine.links is not links:
            return
        links.handle_timer(self.network.now)
        links._tunnels._closed.clear()  # a link of the simulation keeps its port
        self.network.send_pending(machine.label)
        self.network.call(PACE_S, partial(self._look, machine, links))

    def link(self, one: str, other: str) -> TunnelLink:
        """Return the link between two machines, made at the first call."""
        ends = frozenset((one, other))
        known = self.links.get(ends)
        if known is None:
            known = self.links[ends] = TunnelLink(DELAY_S, loss=1.0)
            self.network.connect(one, other, known, cost=COST)
            receivers = {self.port(each, known)[1]: each for each in sorted(ends)}
            known.passes = partial(self._passes, receivers)
        return known

    def port(self, label: str, link: SimLink) -> tuple[int, bytes]:
        """Return the index of a machine's port at a link, and its address."""
        ports = self.network._nodes[label].ports
        return next((index, own.mac) for index, (its, own, _) in ports.items() if its is link)

    def _passes(self, receivers: Mapping[bytes, str], mac: bytes) -> bool:
        """Send a packet through both NATs; return whether it is received."""
        to = self.machines[receivers[mac]]
        sender = self.machines[next(label for label in receivers.values() if label != to.label)]
        at = sender.device.endpoints.get(to.key)
        if at is None or to.label not in sender.open_to:
            return False
        now = self.network.now
        source = sender.gateway.outbound(at, now.mono_s)
        if at.address != to.gateway.address or to.label in self.dead:
            return False
        if sender.label == BORDER:
            source = _PUBLIC
        if to.label != BORDER and not to.gateway.admits(source, at.port, now.mono_s):
            return False
        if sender.key not in to.device.endpoints or not _has_session(sender, to, now.mono_s):
            return False
        to.device.endpoints[sender.key] = source
        to.device.heard_unix_s.setdefault(sender.key, now.unix_s)
        return sender.label in to.open_to

    def is_direct(self, one: str, other: str) -> bool:
        """Return whether two machines are neighbours."""
        ends = ((one, other), (other, one))
        return all(
            self.world.identities[far].name
            in {each.name for each in self.world.switches[near].hello_protocol.neighbours.all_up()}
            for near, far in ends
        )

    def kill(self, *labels: str) -> None:
        """Kill switches or RIBs; ``restart`` brings them back."""
        for label in set(labels) - self.dead:
            self.dead.add(label)
            if label in self.world.ribs:
                self.world.kill_rib(label)
                continue
            self.network.stop(label)
            if label in self.machines:
                self._close(self.machines[label])

    def _close(self, machine: Machine) -> None:
        links, machine.links = machine.links, None
        machine.open_to, machine.device = set(), Device(machine)
        if links is not None:
            links._own.close()

    def restart(self, *labels: str) -> None:
        """Start what was killed, without any state."""
        for label in sorted(self.dead & set(labels)):
            self.dead.remove(label)
            if label in self.world.ribs:
                self.world.restart_rib(label)
                continue
            self.world.restart_switch(label)
            if label in self.machines:
                self.machines[label].gateway.socket = LISTEN
                self._start(label)

    def close(self) -> None:
        """Release the descriptors of all links."""
        for machine in self.machines.values():
            self._close(machine)


def _has_session(one: Machine, other: Machine, now_s: float) -> bool:
    """Return whether two devices have a session, which begins or is renewed only with equal preshared keys."""
    session, theirs = one.device.sessions.get(other.key), other.device.sessions.get(one.key)
    age_s = now_s - session.made_s if session is not None and session is theirs else _REJECT_AFTER_S
    ours, far = (a.device.preshared.get(b.key, NO_KEY) for a, b in ((one, other), (other, one)))
    if age_s >= _REKEY_AFTER_S and ours == far:
        one.device.sessions[other.key] = other.device.sessions[one.key] = Session(now_s)
        return True
    return age_s < _REJECT_AFTER_S


@dataclass(slots=True)
class Loop:
    """Runtime of one machine: its ports are those of the simulation."""

    bed: Tunnelled
    label: str
    ports: dict[int, str] = field(default_factory=dict)  # the machine at the far end

    def add_port(self, ifname: str, _: int) -> int:
        me = self.bed.world.identities[self.label].name
        peers = {
            tunnel_ifname(me, TunnelId(self.bed.world.identities[label].name, 0, 0)): label
            for label in self.bed.machines
        }
        peer = peers[ifname]
        link = self.bed.link(self.label, peer)
        index, mac = self.bed.port(self.label, link)
        self.bed.world.switches[self.label].add_port(index, mac, link.mtu, COST, self.bed.network.now)
        self.bed.machines[self.label].open_to.add(peer)
        self.ports[index] = peer
        return index

    def remove_port(self, index: int) -> None:
        self.bed.machines[self.label].open_to.discard(self.ports.pop(index))
        self.bed.world.switches[self.label].port_changed(index, False, self.bed.network.now)

    def watch(self, *_: object) -> None:
        """No descriptor becomes readable."""

    unwatch = after_receive = watch


@contextmanager
def tunnelled(
    nats: Mapping[str, Nat | None], other_rib: str = BORDER, leaves: Collection[str] = (), seed: int = 1
) -> Iterator[Tunnelled]:
    """Yield machines behind NATs, with all members attached."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        bed = Tunnelled(Path(folder), nats, other_rib, leaves, seed)
        stack.callback(bed.close)
        now = SimpleNamespace(
            monotonic=lambda: bed.network.now.mono_s,
            time=lambda: bed.network.now.unix_s,
            time_ns=lambda: int(bed.network.now.unix_s * 1e9),
        )
        for name in ("make_vxlan", "remove_link", "set_link_mtu"):
            stack.enter_context(mock.patch(f"gdp.links.tunnels.{name}"))
        stack.enter_context(mock.patch("gdp.links.tunnels.route_mtu", return_value=1_500))
        stack.enter_context(mock.patch("gdp.links.tunnels.time", now))
        stack.enter_context(mock.patch("gdp.links.own_endpoints.host_addresses", return_value=()))
        stack.enter_context(mock.patch("gdp.links.own_endpoints.time", now))
        stack.enter_context(mock.patch("gdp.links.endpoint_files.time", now))
        bed.begin()
        yield bed
