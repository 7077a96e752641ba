"""Tunnel devices of a switch: WireGuard for each uplink, and for each tunnel a VXLAN device with a port on it.

I/O. A tunnel that cannot be made is logged; it ends neither the switch nor another tunnel.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Final

from gdp.config.config import LinksConfig
from gdp.control.endpoints import UPLINKS_MAX, Endpoint, EndpointRecord, inner_address, tunnel_vni
from gdp.control.preshared_key import NO_KEY
from gdp.control.tunnel_plan import UNDERLAY_PREFIXES, TunnelId, tunnel_ifname, underlay_ifname
from gdp.crypto.identity import Identity
from gdp.crypto.tunnel_key import TunnelKey
from gdp.errors import LocalError
from gdp.intervals import FORGET_S, UPKEEP_S
from gdp.limits import COST_AUTO
from gdp.names import Name
from gdp.ports.tunnel.control import PeerState
from gdp.ports.tunnel.outside_filter import OutsideFilter
from gdp.ports.tunnel.path_mtu import route_mtu, tunnel_mtu
from gdp.ports.tunnel.rate_limit import limit_rate
from gdp.ports.tunnel.uplink_routes import mark_of, remove_leftovers
from gdp.ports.tunnel.vxlan import VXLAN_PORT, make_vxlan, remove_link, set_link_mtu
from gdp.ports.tunnel.wireguard import WireGuardDevice, open_wireguard
from gdp.runtime.runtime import Runtime
from gdp.sansio import Timestamps
from gdp.switch.core import SwitchCore

log = logging.getLogger(__name__)

_OUTER_MTU: Final = 1_500  # until a route to an endpoint is known
_STATES_PAUSE_S: Final = 0.02  # between two reads of the states of all peers
_HANDSHAKE_S: Final = 3.0  # states are read often for this time after a handshake was requested


@dataclass(slots=True, kw_only=True)
class Tunnel:
    """A tunnel that exists.

    Attributes:
        inner: inner address of the far end.
        key: WireGuard public key of the far end.
        mtu: of the VXLAN device, bytes after the Ethernet header.
        endpoint: where WireGuard sends to; None: it waits for the peer's packets.
        handshake_unix_s: of the last handshake; 0: there was none.
        is_direct: opened by decision of the switch, not by configuration.
        dialled_s: when a handshake was requested last.
        preshared_unix_s: since when new handshakes have a preshared key; infinite: they have none.
    """

    ifname: str
    inner: str
    key: bytes
    port: int
    mtu: int
    wireguard_mtu: int
    keepalive_s: int
    begun_s: float
    is_direct: bool
    endpoint: Endpoint | None = None
    handshake_unix_s: float = 0.0
    dialled_s: float = float("-inf")
    preshared_unix_s: float = float("inf")

    @property
    def is_preshared(self) -> bool:
        """Return whether the present session of WireGuard has a preshared key."""
        return self.handshake_unix_s > self.preshared_unix_s


@contextlib.contextmanager
def open_underlays(config: LinksConfig, identity: Identity) -> Iterator[tuple[WireGuardDevice, ...]]:
    """Make the WireGuard device of each uplink until the context ends.

    Raises:
        LocalError: there is no WireGuard here, the port is taken, or the process may not make devices.
    """
    wireguard_mtu, _ = tunnel_mtu(_OUTER_MTU, is_ipv6=True)
    ifnames = [underlay_ifname(identity.name, uplink) for uplink in range(UPLINKS_MAX)]
    remove_leftovers(map(mark_of, ifnames))  # of a dead run, perhaps with more uplinks
    with contextlib.ExitStack() as stack:
        try:
            stack.callback(OutsideFilter(f"gdp-{ifnames[0]}", VXLAN_PORT, UNDERLAY_PREFIXES).close)
        except LocalError as error:
            log.warning("hosts that reach this one by IPv6 can send frames into its tunnels reason=%s", error)
        devices = []
        for uplink in range(max(len(config.uplinks), 1)):
            device = open_wireguard(
                ifname=ifnames[uplink],
                private_key=TunnelKey.derive(identity.kem, uplink).private,
                listen_port=config.listen + uplink if config.listen else 0,
                inner=inner_address(identity.name, uplink),
                mtu=wireguard_mtu,
                alias=_alias(identity.name),
                backend=config.backend,
                uplink=config.uplinks[uplink] if config.uplinks else "",
            )
            stack.callback(device.close)
            devices.append(device)
            log.info("tunnels over ifname=%s backend=%s port=%d", device.ifname, device.backend, device.listen_port)
            if device.reason:
                log.info("not the kernel's WireGuard reason=%s", device.reason)
        yield tuple(devices)


def _alias(name: Name) -> str:
    return f"gdp-switch {name.to_text()}"


class Tunnels:
    """The tunnels of a running switch.

    Args:
        underlays: a WireGuard device for each uplink.
        relay_rate: bytes per second into each tunnel; None: unlimited.

    Attributes:
        underlays: the WireGuard devices, by uplink.
    """

    def __init__(
        self,
        *,
        identity: Identity,
        switch: SwitchCore,
        runtime: Runtime,
        underlays: tuple[WireGuardDevice, ...],
        relay_rate: int | None = None,
    ) -> None:
        self._me = identity.name
        self._switch = switch
        self._runtime = runtime
        self.underlays = underlays
        self._relay_rate = relay_rate
        self._tunnels: dict[TunnelId, Tunnel] = {}
        self._device_due_s = float("-inf")
        self._read_s = [float("-inf") for _ in underlays]  # when the states of peers were read
        self._answered: list[TunnelId] = []  # not returned by ``look`` yet
        self._is_read_due = [False for _ in underlays]
        self._closed: deque[tuple[float, int]] = deque()  # ports that the control plane may still name
        for uplink, device in enumerate(underlays):
            runtime.watch(device, partial(self._handle_events, uplink))
        if underlays:
            runtime.after_receive(self._look_at_polled)

    @property
    def all(self) -> Mapping[TunnelId, Tunnel]:
        """Return the tunnels that exist."""
        return MappingProxyType(self._tunnels)

    def is_up(self, tunnel: TunnelId) -> bool:
        """Return whether the peer is a neighbour over a tunnel."""
        found = self._tunnels.get(tunnel)
        return found is not None and self._switch.hello_protocol.neighbours.get(found.port, tunnel.peer) is not None

    def has_route(self, uplink: int) -> Callable[[Endpoint], bool]:
        """Return the function that says whether an uplink has a route to an endpoint."""
        return partial(_has_route, fwmark=self.underlays[uplink].fwmark)

    def open(
        self,
        tunnel: TunnelId,
        record: EndpointRecord,
        endpoint: Endpoint | None,
        *,
        keepalive_s: int,
        now_s: float,
        is_direct: bool = False,
    ) -> bool:
        """Make a tunnel; return whether it was made.

        Args:
            endpoint: to dial; None: the peer dials this switch.
            now_s: monotonic seconds.
        """
        underlay = self.underlays[tunnel.uplink]
        ifname, key = tunnel_ifname(self._me, tunnel), record.keys[tunnel.peer_uplink]
        if not self._make_way(tunnel, key, now_s):
            return False
        inner = inner_address(tunnel.peer, tunnel.peer_uplink)
        wireguard_mtu, mtu = _mtus(endpoint, underlay.fwmark)
        try:
            underlay.set_peer(key, inner=inner, endpoint=endpoint, keepalive_s=keepalive_s)
            self._widen(tunnel.uplink, wireguard_mtu)
            self._make_vxlan(tunnel, ifname, mtu)
            port = self._runtime.add_port(ifname, COST_AUTO)
        except LocalError as error:
            log.error("tunnel not made peer=%s reason=%s; it is tried again", tunnel.peer.short, error)
            self._remove(tunnel.uplink, ifname, key)
            return False
        self._switch.hello_protocol.liveness.set_uplink(port, tunnel.uplink)
        self._switch.hello_protocol.preshared_keys.agree(port, tunnel.peer)
        self._tunnels[tunnel] = Tunnel(
            ifname=ifname,
            inner=inner,
            key=key,
            port=port,
            mtu=mtu,
            wireguard_mtu=wireguard_mtu,
            keepalive_s=keepalive_s,
            begun_s=now_s,
            dialled_s=now_s,
            is_direct=is_direct,
            endpoint=endpoint,
        )
        at = "where it dials from" if endpoint is None else endpoint.to_text()
        log.info("tunnel made peer=%s ifname=%s endpoint=%s", tunnel.peer.short, ifname, at)
        return True

    def _make_way(self, tunnel: TunnelId, key: bytes, now_s: float) -> bool:
        """Return whether a tunnel may use a key: another peer's with the same key stays if it is up, else it is closed.

        A record does not prove its key. Only who has the key can come up, and a device has one peer for each key.
        """
        for other, found in list(self._tunnels.items()):
            if other.uplink == tunnel.uplink and other.peer != tunnel.peer and found.key == key:
                if self.is_up(other):
                    log.warning("tunnel not made peer=%s reason=%s has its key", tunnel.peer.short, other.peer.short)
                    return False
                self.close(other, now_s)
        return True

    def dial(self, tunnel: TunnelId, endpoint: Endpoint | None) -> None:
        """Send a handshake to an endpoint, or to the last one again."""
        found, device = self._tunnels[tunnel], self.underlays[tunnel.uplink]
        found.dialled_s = time.monotonic()
        try:
            self._set_preshared(device, found)
            device.set_peer(found.key, inner=found.inner, endpoint=endpoint, keepalive_s=found.keepalive_s)
            device.retry_handshake(found.key)
        except LocalError as error:
            at = "?" if endpoint is None else endpoint.to_text()
            log.warning("not dialled peer=%s endpoint=%s reason=%s", tunnel.peer.short, at, error)

    def silence(self, peer: Name) -> None:
        """Send nothing to a peer until it sends, or is dialled."""
        for tunnel, found in self._tunnels.items():
            if tunnel.peer == peer and found.is_direct:
                device = self.underlays[tunnel.uplink]
                try:
                    device.remove_peer(found.key)
                    device.set_peer(found.key, inner=found.inner, endpoint=None, keepalive_s=found.keepalive_s)
                except LocalError as error:
                    log.warning("not silenced peer=%s reason=%s", peer.short, error)

    def close(self, tunnel: TunnelId, now_s: float) -> None:
        """Remove a tunnel with its port; its neighbour is lost at once."""
        found = self._tunnels.pop(tunnel)
        self._runtime.remove_port(found.port)
        self._switch.tunnels.set_direct_port(found.port, None)
        self._closed.append((now_s + FORGET_S, found.port))
        self._remove(tunnel.uplink, found.ifname, found.key)
        log.info("tunnel removed peer=%s ifname=%s", tunnel.peer.short, found.ifname)

    def _remove(self, uplink: int, ifname: str, key: bytes) -> None:
        """Remove the device of a tunnel, and its WireGuard peer unless another tunnel has it; a refusal is logged."""
        try:
            remove_link(ifname, _alias(self._me))
            if not any(tunnel.uplink == uplink and each.key == key for tunnel, each in self._tunnels.items()):
                self.underlays[uplink].remove_peer(key)
        except LocalError as error:
            log.error("tunnel not removed ifname=%s reason=%s", ifname, error)

    def rebind(self, uplink: int) -> None:
        """Let an uplink send from another UDP port."""
        device = self.underlays[uplink]
        try:
            device.rebind()
        except LocalError as error:
            log.error("not sending from another port ifname=%s reason=%s", device.ifname, error)
            return
        log.warning("no border answers, sending from another port ifname=%s port=%d", device.ifname, device.listen_port)

    def close_peer(self, peer: Name, now_s: float) -> None:
        """Remove all tunnels to a peer."""
        for tunnel in [each for each in self._tunnels if each.peer == peer]:
            self.close(tunnel, now_s)

    def close_all(self, now_s: float) -> None:
        """Remove all tunnels, and stop watching the devices."""
        for tunnel in list(self._tunnels):
            self.close(tunnel, now_s)
        for device in self.underlays:
            self._runtime.unwatch(device)

    def handle_timer(self, now: Timestamps) -> list[TunnelId]:
        """Follow where WireGuard hears each peer, and the MTU of the paths; return tunnels with a new handshake."""
        self._follow_preshared()
        is_device_due = now.mono_s >= self._device_due_s
        if is_device_due:
            self._device_due_s = now.mono_s + UPKEEP_S
            for uplink, device in enumerate(self.underlays):
                self._read_s[uplink] = now.mono_s
                if device.poll():
                    self._remake(device)
                self._report_move(uplink)
            for tunnel, found in self._tunnels.items():
                if self.is_up(tunnel):
                    self._follow_mtu(tunnel, found)
        for uplink, device in enumerate(self.underlays):
            if is_device_due:
                self._observe_all(uplink, device.known_peers())
            elif self._is_read_due[uplink] or self._has_unknown(uplink, now.mono_s):
                self._read_states(uplink, now.mono_s)
        while self._closed and now.mono_s >= self._closed[0][0]:
            self._switch.hello_protocol.remove_port(self._closed.popleft()[1])
        answered, self._answered = self._answered, []
        return answered

    def _follow_preshared(self) -> None:
        """Let WireGuard have the preshared key that both ends have, and none from when the peer is lost."""
        for tunnel, found in list(self._tunnels.items()):
            try:
                self._set_preshared(self.underlays[tunnel.uplink], found)
            except LocalError as error:
                log.error("no preshared key peer=%s reason=%s; the tunnel is made again", tunnel.peer.short, error)
                self.close(tunnel, time.monotonic())

    def _set_preshared(self, device: WireGuardDevice, found: Tunnel) -> None:
        key = self._switch.hello_protocol.preshared_keys.key(found.port)
        if device.set_preshared_key(found.key, key):
            found.preshared_unix_s = float("inf") if key == NO_KEY else time.time()

    def _has_unknown(self, uplink: int, now_s: float) -> bool:
        """Return whether WireGuard may soon know more: a handshake was requested, or a peer has just come up."""
        protocol = self._switch.hello_protocol
        return any(
            protocol.neighbours.observed_at(found.port, tunnel.peer) is None
            if self.is_up(tunnel)
            else now_s < found.dialled_s + _HANDSHAKE_S
            for tunnel, found in self._tunnels.items()
            if tunnel.uplink == uplink
        )

    def _look_at_polled(self) -> None:
        """Look at once where a peer is that has polled this switch: it learns so that its address has changed."""
        ports = self._switch.hello_protocol.liveness.poll_polled()
        if not ports:
            return
        now_s = time.monotonic()
        for uplink in {tunnel.uplink for tunnel, found in self._tunnels.items() if found.port in ports}:
            self._is_read_due[uplink] = True
            if now_s >= self._read_s[uplink] + _STATES_PAUSE_S:
                self._read_states(uplink, now_s)

    def _read_states(self, uplink: int, now_s: float) -> None:
        self._read_s[uplink], self._is_read_due[uplink] = now_s, False
        self._observe_all(uplink, _states_of(self.underlays[uplink]))

    def _observe_all(self, uplink: int, states: Mapping[bytes, PeerState]) -> None:
        for tunnel, found in self._tunnels.items():
            state = states.get(found.key) if tunnel.uplink == uplink else None
            if state is not None and self._observe(tunnel, found, state):
                self._answered.append(tunnel)

    def _observe(self, tunnel: TunnelId, found: Tunnel, state: PeerState) -> bool:
        """Record what WireGuard reports about a peer; return whether there is a new handshake."""
        if state.handshake_unix_s and state.endpoint not in (None, found.endpoint):
            log.info("peer seen at another address peer=%s endpoint=%s", tunnel.peer.short, state.endpoint)
        found.endpoint = state.endpoint or found.endpoint
        if state.handshake_unix_s:
            self._switch.hello_protocol.set_observed(found.port, tunnel.peer, state.endpoint)
        is_new = state.handshake_unix_s > found.handshake_unix_s
        found.handshake_unix_s = state.handshake_unix_s
        return is_new

    # devices

    def _handle_events(self, uplink: int) -> None:
        device = self.underlays[uplink]
        if device.handle_events():
            self._remake(device)
        self._report_move(uplink)

    def _report_move(self, uplink: int) -> None:
        """Probe the neighbours over an uplink whose address has changed."""
        if self.underlays[uplink].poll_move():
            self._switch.hello_protocol.probe_uplink(uplink, time.monotonic())

    def _remake(self, device: WireGuardDevice) -> None:
        """Make the VXLAN devices on a device that was made again; their ports open when they appear."""
        for tunnel, found in list(self._tunnels.items()):
            if self.underlays[tunnel.uplink] is device:
                try:
                    self._make_vxlan(tunnel, found.ifname, found.mtu)
                except LocalError as error:
                    log.error("tunnel not made again peer=%s reason=%s", tunnel.peer.short, error)
                    self.close(tunnel, time.monotonic())  # it is opened again later

    def _make_vxlan(self, tunnel: TunnelId, ifname: str, mtu: int) -> None:
        local, remote = inner_address(self._me, tunnel.uplink), inner_address(tunnel.peer, tunnel.peer_uplink)
        make_vxlan(
            ifname=ifname,
            vni=tunnel_vni(local, remote),
            local=local,
            remote=remote,
            underlay=self.underlays[tunnel.uplink].ifname,
            mtu=mtu,
            alias=_alias(self._me),
        )
        if self._relay_rate is not None:
            limit_rate(ifname, self._relay_rate)

    def _follow_mtu(self, tunnel: TunnelId, found: Tunnel) -> None:
        outer = self.underlays[tunnel.uplink].path_mtu(found.key)
        if outer is None or found.endpoint is None:  # not known now
            return
        wireguard_mtu, mtu = tunnel_mtu(outer, is_ipv6=":" in found.endpoint.address)
        if (wireguard_mtu, mtu) == (found.wireguard_mtu, found.mtu):
            return
        found.wireguard_mtu, found.mtu = wireguard_mtu, mtu
        try:
            self._widen(tunnel.uplink, wireguard_mtu)
            set_link_mtu(found.ifname, mtu)
        except LocalError as error:
            log.warning("MTU kept ifname=%s wanted=%d reason=%s", found.ifname, mtu, error)
            return
        log.info("MTU follows the path peer=%s ifname=%s mtu=%d", tunnel.peer.short, found.ifname, mtu)

    def _widen(self, uplink: int, wireguard_mtu: int) -> None:
        """Set the MTU of a WireGuard device to that of its widest tunnel; each VXLAN device has its own."""
        others = (each.wireguard_mtu for tunnel, each in self._tunnels.items() if tunnel.uplink == uplink)
        self.underlays[uplink].set_mtu(max([wireguard_mtu, *others]))


def _states_of(device: WireGuardDevice) -> dict[bytes, PeerState]:
    """Return the peers of a device; none if it is gone, which is reported when it comes back."""
    try:
        return device.peers()
    except LocalError as error:
        log.warning("peers not read ifname=%s reason=%s", device.ifname, error)
        return {}


def _has_route(endpoint: Endpoint, fwmark: int) -> bool:
    try:
        route_mtu(endpoint, fwmark)
    except LocalError:
        return False
    return True


def _mtus(endpoint: Endpoint | None, fwmark: int) -> tuple[int, int]:
    """Return the MTU of WireGuard and of VXLAN towards an endpoint; without a route, those of usual links.

    Args:
        fwmark: of the packets of the uplink.
    """
    if endpoint is None:
        return tunnel_mtu(_OUTER_MTU, is_ipv6=True)
    try:
        outer = route_mtu(endpoint, fwmark)
    except LocalError:
        outer = _OUTER_MTU
    return tunnel_mtu(outer, is_ipv6=":" in endpoint.address)
