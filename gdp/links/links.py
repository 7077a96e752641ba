"""Tunnels of a switch: which exist, by configuration or by its own decision, and what it publishes about itself.

I/O. The switch's identity yields the WireGuard keys and the inner addresses; endpoint records name those of its peers.
Files ``*.endpoints`` hold the records of the configured peers, usually borders, or all members of a border::

    record of a peer -> WireGuard peer, VXLAN device -> port -> hello protocol: the neighbour is up, or not
    WireGuard        -> where a peer's packets come from -> our hello -> the peer's record -> RIB -> direct tunnels
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.config.config import LinksConfig
from gdp.control.endpoints import EndpointRecord
from gdp.control.tunnel_plan import Dialer, RebindSchedule, TunnelId, planned_tunnels
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.errors import GdpError, LocalError
from gdp.intervals import REPORT_S, RETRY_S
from gdp.links.endpoint_files import record_files
from gdp.links.own_endpoints import OwnEndpoints
from gdp.links.tunnels import Tunnel, Tunnels
from gdp.names import Name
from gdp.ports.tunnel.wireguard import WireGuardDevice
from gdp.runtime.runtime import Runtime
from gdp.sansio import Timestamps
from gdp.stores.files import read_public
from gdp.switch.core import SwitchCore
from gdp.switch.direct_tunnels import Close, Open, Retry, Silence
from gdp.trust.domain import Policy

log = logging.getLogger(__name__)

_RECORDS_PERIOD_S: Final = 0.3


@dataclass(slots=True, kw_only=True)
class _Peer:
    """A configured peer."""

    record: EndpointRecord
    member: Membership


class TunnelLinks:
    """Decisions on the tunnels of a running switch; ``underlays``: a WireGuard device for each uplink."""

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
        self._me = identity.name
        self._policy = policy
        self._switch = switch
        self._tunnels = Tunnels(
            identity=identity, switch=switch, runtime=runtime, underlays=underlays, relay_rate=config.relay_rate
        )
        self._own = OwnEndpoints(config=config, identity=identity, switch=switch, tunnels=self._tunnels)
        self._files: dict[Path, tuple[int, int]] = {}  # size and time of what was read
        self._configured: dict[Path, _Peer] = {}
        self._direct: dict[Name, str] = {}  # labels of the peers of direct tunnels
        self._dialers: dict[TunnelId, Dialer] = {}
        self._retry_s: dict[TunnelId, float] = {}
        self._reported: set[TunnelId] = set()
        self._rebinds = [RebindSchedule() for _ in underlays]
        self._records_s = float("-inf")

    @property
    def ports(self) -> frozenset[int]:
        """Return the port indices of tunnels."""
        return frozenset(each.port for each in self._tunnels.all.values())

    def handle_timer(self, now: Timestamps) -> None:
        """Follow the records, the endpoints of peers and the decisions of the switch."""
        if now.mono_s >= self._records_s:
            self._records_s = now.mono_s + _RECORDS_PERIOD_S
            self._read_records(now)
            self._follow_configured(now)
        for tunnel in self._tunnels.handle_timer(now):
            self._switch.tunnels.answered(tunnel.peer, now)
        if self._config.direct:
            self._own.publish_changes(now)
            self._act(now)

    def close(self, now_s: float) -> None:
        """Remove the ports and devices of all tunnels."""
        self._tunnels.close_all(now_s)
        self._own.close()

    def status(self, now: Timestamps) -> list[dict[str, object]]:
        """Return the JSON fields of each tunnel."""
        labels = self._direct | {each.record.name: each.member.label for each in self._configured.values()}
        return [self._row(tunnel, found, labels, now) for tunnel, found in self._tunnels.all.items()]

    def _row(self, tunnel: TunnelId, found: Tunnel, labels: Mapping[Name, str], now: Timestamps) -> dict[str, object]:
        age_s = round(now.unix_s - found.handshake_unix_s, 1) if found.handshake_unix_s else None
        neighbour = self._switch.hello_protocol.neighbours.get(found.port, tunnel.peer)
        member = None if neighbour is None else neighbour.member
        return {
            "peer": tunnel.peer.to_text(),
            "label": labels.get(tunnel.peer) if member is None else member.label,
            "device": found.ifname,
            "via": self._tunnels.underlays[tunnel.uplink].backend,
            "direct": found.is_direct,
            "endpoint": None if found.endpoint is None else found.endpoint.to_text(),
            "handshake_age_s": age_s,
            "preshared": found.is_preshared,
            "mtu": found.mtu,
            "up": neighbour is not None,
            "why": self._switch.tunnels.failure(tunnel.peer) if found.is_direct and neighbour is None else "",
        }

    # configured peers

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
        self._switch.tunnels.set_configured_peers({peer.record.name for peer in self._configured.values()})

    def _read_record(self, path: Path, now: Timestamps) -> None:
        try:
            record, member = EndpointRecord.verified(read_public(path), self._policy, now.unix_s)
            if record.name == self._me:
                raise LocalError("it is this switch's own record")
            self._check_served(member)
        except (GdpError, OSError) as error:
            log.error("endpoint record not taken file=%s reason=%s", path, error)
            self._configured.pop(path, None)
            return
        known = self._configured.get(path)
        if known is not None and known.record.keys != record.keys:
            self._tunnels.close_peer(record.name, now.mono_s)
        for tunnel in planned_tunnels(len(self._tunnels.underlays), record):
            self._dialers[tunnel] = Dialer.to(record, tunnel.peer_uplink)
        self._configured[path] = _Peer(record=record, member=member)

    def _check_served(self, member: Membership) -> None:
        """Return if this switch has tunnels to a member. Raises ``LocalError``: ``relay_for`` leaves it out."""
        served = self._config.relay_for
        if served and member.label not in served and member.role.value not in served:
            raise LocalError(f"neither its label {member.label} nor its role {member.role.value} is in links.relay_for")

    def _follow_configured(self, now: Timestamps) -> None:
        """Open and close the tunnels to configured peers, and dial those that do not answer."""
        wanted = {
            tunnel: peer
            for peer in self._configured.values()
            for tunnel in planned_tunnels(len(self._tunnels.underlays), peer.record)
        }
        for tunnel, found in list(self._tunnels.all.items()):
            if tunnel not in wanted and not found.is_direct:
                self._tunnels.close(tunnel, now.mono_s)
        for tunnel in self._dialers.keys() - wanted.keys():
            del self._dialers[tunnel]
        self._reported &= wanted.keys()
        for tunnel, peer in wanted.items():
            dialer = self._dialers[tunnel]
            is_up = self._tunnels.is_up(tunnel)
            if tunnel in self._tunnels.all:
                endpoint = dialer.next(now.mono_s, is_up=is_up, has_route=self._tunnels.has_route(tunnel.uplink))
                if endpoint is not None:
                    self._tunnels.dial(tunnel, endpoint)
                self._report_silence(tunnel, peer, now, is_up=is_up)
            elif now.mono_s >= self._retry_s.get(tunnel, 0.0):
                self._retry_s[tunnel] = now.mono_s + RETRY_S
                self._tunnels.open(
                    tunnel,
                    peer.record,
                    dialer.next(now.mono_s, is_up=False, has_route=self._tunnels.has_route(tunnel.uplink)),
                    keepalive_s=self._config.keepalive_s if dialer.endpoints else 0,
                    now_s=now.mono_s,
                )

        if not self._config.public:
            self._rebind_silent(now.mono_s)

    def _rebind_silent(self, now_s: float) -> None:
        """Let an uplink over which no border answers any more send from another UDP port, unless a tunnel is up."""
        up = [tunnel for tunnel in self._tunnels.all if self._tunnels.is_up(tunnel)]
        for uplink, schedule in enumerate(self._rebinds):
            dialers = [self._dialers.get(tunnel) for tunnel in up if tunnel.uplink == uplink]
            is_border_up = any(dialer is not None and dialer.endpoints for dialer in dialers)
            if schedule.update(now_s, is_up=is_border_up, is_held=bool(dialers)):
                self._tunnels.rebind(uplink)

    def _report_silence(self, tunnel: TunnelId, peer: _Peer, now: Timestamps, *, is_up: bool) -> None:
        """Report a border that does not answer, once until it does."""
        endpoints = self._dialers[tunnel].endpoints
        if is_up or not endpoints:
            self._reported.discard(tunnel)
        elif tunnel not in self._reported and now.mono_s > self._tunnels.all[tunnel].begun_s + REPORT_S:
            self._reported.add(tunnel)
            where = ", ".join(each.to_text() for each in endpoints)
            cause = "it is down, its membership or ours is refused there, or UDP is blocked on the way"
            log.warning("no answer through the tunnel peer=%s at=%s: %s", peer.member.label, where, cause)

    # direct tunnels

    def _act(self, now: Timestamps) -> None:
        """Do what the switch decided about direct tunnels."""
        for action in self._switch.tunnels.poll_actions(now):
            if not isinstance(action, Close) and not self._is_served(action.record, now):
                continue
            match action:
                case Close(peer):
                    self._tunnels.close_peer(peer, now.mono_s)
                    self._direct.pop(peer, None)
                case Silence(record):
                    self._tunnels.silence(record.name)
                case Open(record, candidate, uplink, peer_uplink) | Retry(record, candidate, uplink, peer_uplink):
                    tunnel = TunnelId(record.name, uplink, peer_uplink)
                    endpoint = None if candidate is None else candidate.endpoint
                    if tunnel in self._tunnels.all:
                        self._tunnels.dial(tunnel, endpoint)
                    elif self._tunnels.open(
                        tunnel,
                        record,
                        endpoint,
                        keepalive_s=self._config.keepalive_s,
                        now_s=now.mono_s,
                        is_direct=True,
                    ):
                        self._switch.tunnels.set_direct_port(self._tunnels.all[tunnel].port, record.name)

    def _is_served(self, record: EndpointRecord, now: Timestamps) -> bool:
        try:
            member = self._policy.verify_membership(record.membership, now.unix_s)
            self._check_served(member)
        except GdpError as error:
            log.debug("no direct tunnel peer=%s reason=%s", record.name.short, error)
            return False
        self._direct[record.name] = member.label
        return True
