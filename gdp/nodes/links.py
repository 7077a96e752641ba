"""Tunnels of a switch: WireGuard devices, a VXLAN device for each peer, and a port on each of these.

I/O. The switch's identity yields the WireGuard keys and the inner addresses; endpoint records name those of its peers.
Files ``*.endpoints`` hold the records of the configured peers, usually borders, or all members of a border::

    record of a peer -> WireGuard peer, VXLAN device -> port -> hello protocol: the neighbour is up, or not
    WireGuard        -> where a peer's packets come from -> its hello: the address that it has outside its NAT

A tunnel that cannot be made is logged and tried again; it ends neither the switch nor another tunnel.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from gdp.control.endpoint_record import EndpointRecord
from gdp.control.endpoints import Endpoint, inner_address, tunnel_vni
from gdp.control.tunnel_plan import Dialer, TunnelId, planned_tunnels, tunnel_ifname, underlay_ifname
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.tunnel_key import TunnelKey
from gdp.errors import GdpError, LocalError
from gdp.limits import COST_AUTO
from gdp.names import Name
from gdp.nodes.config import LinksConfig
from gdp.nodes.endpoint_files import record_files
from gdp.nodes.runtime import Runtime
from gdp.ports.tunnel.path_mtu import route_mtu, tunnel_mtu
from gdp.ports.tunnel.vxlan import make_vxlan, remove_link, set_link_mtu
from gdp.ports.tunnel.wireguard import PeerState, WireGuardDevice, open_wireguard
from gdp.sansio import Timestamps
from gdp.stores.files import read_public
from gdp.switch.core import SwitchCore
from gdp.trust.domain import Policy

__all__ = ["LINKS_LOOK_S", "TunnelLinks", "open_underlays"]

log = logging.getLogger(__name__)

LINKS_LOOK_S: Final = 0.25
_OUTER_MTU: Final = 1_500  # until a route to an endpoint is known
_MTU_LOOK_S: Final = 1.0
_POLL_S: Final = 1.0
_RETRY_S: Final = 5.0
_FORGET_S: Final = 60.0  # after this time no tree and no table entry names a removed port
_SILENT_S: Final = 5.0  # a border that is not up after this time is reported


@dataclass(slots=True, kw_only=True)
class _Peer:
    record: EndpointRecord
    member: Membership


@dataclass(slots=True, kw_only=True)
class _Tunnel:
    """A tunnel that exists."""

    ifname: str
    inner: str  # of the far end
    key: bytes  # of the far end
    port: int
    mtu: int
    wireguard_mtu: int
    dialer: Dialer
    begun_s: float
    endpoint: Endpoint | None = None
    handshake_unix_s: float = 0.0
    is_reported: bool = False
    mtu_look_s: float = field(default=float("-inf"))


@contextlib.contextmanager
def open_underlays(config: LinksConfig, identity: Identity) -> Iterator[tuple[WireGuardDevice, ...]]:
    """Make the WireGuard device of each uplink until the context ends.

    Raises:
        LocalError: there is no WireGuard here, the port is taken, or the process may not make devices.
    """
    wireguard_mtu, _ = tunnel_mtu(_OUTER_MTU, is_ipv6=True)
    with contextlib.ExitStack() as stack:
        devices = []
        for uplink in range(max(len(config.uplinks), 1)):
            device = open_wireguard(
                ifname=underlay_ifname(identity.name, uplink),
                private_key=TunnelKey.derive(identity.kem, uplink).private,
                listen_port=config.listen + uplink if config.listen else 0,
                inner=inner_address(identity.name, uplink),
                mtu=wireguard_mtu,
                alias=_alias(identity.name),
                backend=config.backend,
            )
            stack.callback(device.close)
            devices.append(device)
            log.info("tunnels over ifname=%s backend=%s port=%d", device.ifname, device.backend, device.listen_port)
            if device.reason:
                log.info("not the kernel's WireGuard reason=%s", device.reason)
        yield tuple(devices)


def _alias(name: Name) -> str:
    return f"gdp-switch {name.to_text()}"


class TunnelLinks:
    """The tunnels of a running switch.

    Args:
        underlays: a WireGuard device for each uplink.
    """

    def __init__(
        self,
        *,
        config: LinksConfig,
        identity: Identity,
        policy: Policy,
        switch: SwitchCore,
        runtime: Runtime,
        underlays: tuple[WireGuardDevice, ...],
    ) -> None:
        self._config = config
        self._identity = identity
        self._policy = policy
        self._switch = switch
        self._runtime = runtime
        self._underlays = underlays
        self._files: dict[Path, tuple[int, int]] = {}  # size and time of what was read
        self._configured: dict[Path, _Peer] = {}
        self._tunnels: dict[TunnelId, _Tunnel] = {}
        self._retry_s: dict[TunnelId, float] = {}
        self._poll_s = float("-inf")
        self._closed: deque[tuple[float, int]] = deque()  # ports that the control plane may still name
        for device in underlays:
            runtime.watch(device, partial(self._handle_events, device))

    @property
    def ports(self) -> frozenset[int]:
        """Return the port indices of tunnels."""
        return frozenset(each.port for each in self._tunnels.values())

    def look(self, now: Timestamps) -> None:
        """Follow the records, the endpoints of peers and the MTU of the paths to them."""
        self._read_records(now)
        if now.mono_s >= self._poll_s:
            self._poll_s = now.mono_s + _POLL_S
            for device in self._underlays:
                if device.poll():
                    self._remake(device)
        wanted = {
            tunnel: peer
            for peer in self._configured.values()
            for tunnel in planned_tunnels(len(self._underlays), peer.record)
        }
        for tunnel in self._tunnels.keys() - wanted.keys():
            self._close(tunnel)
        for tunnel, peer in wanted.items():
            if self._tunnels.get(tunnel) is None and now.mono_s >= self._retry_s.get(tunnel, 0.0):
                self._open(tunnel, peer.record, now)
        self._follow(wanted, now)
        while self._closed and now.mono_s >= self._closed[0][0]:
            self._switch.hello_protocol.remove_port(self._closed.popleft()[1])

    def close(self) -> None:
        """Remove the ports and devices of all tunnels."""
        for tunnel in list(self._tunnels):
            self._close(tunnel)
        for device in self._underlays:
            self._runtime.unwatch(device)

    def status(self, now: Timestamps) -> list[dict[str, object]]:
        """Return the JSON fields of each tunnel."""
        return [self._row(tunnel, found, now) for tunnel, found in self._tunnels.items()]

    def _row(self, tunnel: TunnelId, found: _Tunnel, now: Timestamps) -> dict[str, object]:
        peer = next((each for each in self._configured.values() if each.record.name == tunnel.peer), None)
        age_s = round(now.unix_s - found.handshake_unix_s, 1) if found.handshake_unix_s else None
        return {
            "peer": tunnel.peer.to_text(),
            "label": "" if peer is None else peer.member.label,
            "device": found.ifname,
            "via": self._underlays[tunnel.uplink].backend,
            "endpoint": None if found.endpoint is None else found.endpoint.to_text(),
            "handshake_age_s": age_s,
            "mtu": found.mtu,
            "up": self._is_up(tunnel, found),
        }

    def _handle_events(self, device: WireGuardDevice) -> None:
        if device.handle_events():
            self._remake(device)

    def _remake(self, device: WireGuardDevice) -> None:
        """Make the VXLAN devices on a device that was made again; their ports open when they appear."""
        for tunnel, found in self._tunnels.items():
            if self._underlays[tunnel.uplink] is device:
                try:
                    self._make_vxlan(tunnel, found.ifname, found.mtu)
                except LocalError as error:
                    log.error("tunnel not made again peer=%s reason=%s", tunnel.peer.short, error)

    def _make_vxlan(self, tunnel: TunnelId, ifname: str, mtu: int) -> None:
        me = self._identity.name
        local, remote = inner_address(me, tunnel.uplink), inner_address(tunnel.peer, tunnel.peer_uplink)
        make_vxlan(
            ifname=ifname,
            vni=tunnel_vni(local, remote),
            local=local,
            remote=remote,
            underlay=self._underlays[tunnel.uplink].ifname,
            mtu=mtu,
            alias=_alias(me),
        )

    # records

    def _read_records(self, now: Timestamps) -> None:
        """Read new and changed files; drop the peers whose file or membership is gone."""
        present = {} if self._config.peers is None else dict(record_files(self._config.peers))
        for path in self._files.keys() - present.keys():
            del self._files[path]
            self._configured.pop(path, None)
        for path, mark in present.items():
            if self._files.get(path) != mark:
                self._files[path] = mark
                self._read_record(path, now)
        for path, peer in list(self._configured.items()):
            try:
                self._policy.check_member(peer.member, now.unix_s)
            except GdpError as error:
                log.warning("tunnel closed peer=%s reason=%s", peer.member.label, error)
                del self._configured[path]

    def _read_record(self, path: Path, now: Timestamps) -> None:
        try:
            record, member = EndpointRecord.verified(read_public(path), self._policy, now.unix_s)
            if record.name == self._identity.name:
                raise LocalError("it is this switch's own record")
        except (GdpError, OSError) as error:
            log.error("endpoint record not taken file=%s reason=%s", path, error)
            self._configured.pop(path, None)
            return
        known = self._configured.get(path)
        if known is not None and known.record.keys != record.keys:
            self._close_peer(record.name)
        for tunnel in planned_tunnels(len(self._underlays), record):
            if (found := self._tunnels.get(tunnel)) is not None:
                found.dialer = Dialer.to(record, tunnel.peer_uplink)
        self._configured[path] = _Peer(record=record, member=member)

    # tunnels

    def _open(self, tunnel: TunnelId, record: EndpointRecord, now: Timestamps) -> None:
        me, underlay = self._identity.name, self._underlays[tunnel.uplink]
        remote = inner_address(tunnel.peer, tunnel.peer_uplink)
        ifname, key = tunnel_ifname(me, tunnel), record.keys[tunnel.peer_uplink]
        dialer = Dialer.to(record, tunnel.peer_uplink)
        endpoint = dialer.next(now.mono_s, is_up=False)
        wireguard_mtu, mtu = self._mtus(endpoint)
        keepalive_s = self._config.keepalive_s if dialer.endpoints else 0
        try:
            underlay.set_peer(key, inner=remote, endpoint=endpoint, keepalive_s=keepalive_s)
            self._widen(tunnel.uplink, wireguard_mtu)
            self._make_vxlan(tunnel, ifname, mtu)
            port = self._runtime.add_port(ifname, COST_AUTO)
        except LocalError as error:
            log.error("tunnel not made peer=%s reason=%s; it is tried again", tunnel.peer.short, error)
            self._retry_s[tunnel] = now.mono_s + _RETRY_S
            remove_link(ifname, _alias(me))
            return
        self._tunnels[tunnel] = _Tunnel(
            ifname=ifname,
            inner=remote,
            key=key,
            port=port,
            mtu=mtu,
            wireguard_mtu=wireguard_mtu,
            dialer=dialer,
            begun_s=now.mono_s,
            endpoint=endpoint,
        )
        at = "where it dials from" if endpoint is None else endpoint.to_text()
        log.info("tunnel made peer=%s ifname=%s endpoint=%s", tunnel.peer.short, ifname, at)

    def _close(self, tunnel: TunnelId) -> None:
        found = self._tunnels.pop(tunnel)
        self._runtime.remove_port(found.port)
        self._closed.append((time.monotonic() + _FORGET_S, found.port))
        remove_link(found.ifname, _alias(self._identity.name))
        if not any(each.key == found.key for each in self._tunnels.values()):
            self._underlays[tunnel.uplink].remove_peer(found.key)
        log.info("tunnel removed peer=%s ifname=%s", tunnel.peer.short, found.ifname)

    def _close_peer(self, peer: Name) -> None:
        for tunnel in [each for each in self._tunnels if each.peer == peer]:
            self._close(tunnel)

    def _follow(self, wanted: Mapping[TunnelId, _Peer], now: Timestamps) -> None:
        """Follow where WireGuard hears each peer, dial again where nothing answers, and follow the MTU."""
        states = [device.peers() for device in self._underlays]
        for tunnel, found in self._tunnels.items():
            state = states[tunnel.uplink].get(found.key)
            if state is not None:
                self._observe(tunnel, found, state)
            is_up = self._is_up(tunnel, found)
            found.is_reported = found.is_reported and not is_up
            endpoint = found.dialer.next(now.mono_s, is_up=is_up)
            if endpoint is not None:
                self._dial(tunnel, found, endpoint)
            if found.dialer.endpoints and not (is_up or found.is_reported) and now.mono_s > found.begun_s + _SILENT_S:
                found.is_reported = True
                self._report_silence(wanted[tunnel], found)
            if now.mono_s >= found.mtu_look_s:
                found.mtu_look_s = now.mono_s + _MTU_LOOK_S
                self._follow_mtu(tunnel, found)

    def _observe(self, tunnel: TunnelId, found: _Tunnel, state: PeerState) -> None:
        if state.handshake_unix_s and state.endpoint not in (None, found.endpoint):
            log.info("peer seen at another address peer=%s endpoint=%s", tunnel.peer.short, state.endpoint)
        found.endpoint, found.handshake_unix_s = state.endpoint or found.endpoint, state.handshake_unix_s

    def _dial(self, tunnel: TunnelId, found: _Tunnel, endpoint: Endpoint) -> None:
        device = self._underlays[tunnel.uplink]
        try:
            device.set_peer(found.key, inner=found.inner, endpoint=endpoint, keepalive_s=self._config.keepalive_s)
            device.retry_handshake(found.key)
        except LocalError as error:
            log.warning("not dialled peer=%s endpoint=%s reason=%s", tunnel.peer.short, endpoint.to_text(), error)

    def _report_silence(self, peer: _Peer, found: _Tunnel) -> None:
        where = ", ".join(each.to_text() for each in found.dialer.endpoints)
        cause = "it is down, its membership or ours is refused there, or UDP is blocked on the way"
        log.warning("no answer through the tunnel peer=%s at=%s: %s", peer.member.label, where, cause)

    def _is_up(self, tunnel: TunnelId, found: _Tunnel) -> bool:
        return self._switch.hello_protocol.neighbour(found.port, tunnel.peer) is not None

    def _mtus(self, endpoint: Endpoint | None) -> tuple[int, int]:
        """Return the MTU of WireGuard and of VXLAN towards an endpoint; without a route, those of usual links."""
        if endpoint is None:
            return tunnel_mtu(_OUTER_MTU, is_ipv6=True)
        try:
            outer = route_mtu(endpoint)
        except LocalError:
            return tunnel_mtu(_OUTER_MTU, is_ipv6=True)
        return tunnel_mtu(outer, is_ipv6=":" in endpoint.address)

    def _follow_mtu(self, tunnel: TunnelId, found: _Tunnel) -> None:
        wireguard_mtu, mtu = self._mtus(found.endpoint)
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
        self._underlays[uplink].set_mtu(max(wireguard_mtu, *others))
