"""What a switch publishes about itself: its addresses, and the ones at which its peers see it.

I/O; reads the addresses of this host's devices.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Sequence
from typing import Final

from gdp.config.config import LinksConfig
from gdp.control.endpoints import CANDIDATES_MAX, Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.crypto.identity import Identity
from gdp.errors import DropReason, LocalError, StatementError
from gdp.links.endpoint_files import own_record, public_candidates
from gdp.links.tunnels import Tunnels
from gdp.ports.host_addresses import AddressMonitor, host_addresses
from gdp.sansio import Timestamps
from gdp.switch.core import SwitchCore

log = logging.getLogger(__name__)

_ADDRESSES_PERIOD_S: Final = 10.0  # where no notification comes, such as for a device that moves between namespaces


def listed_candidates(
    public: Iterable[Candidate], seen: Iterable[Candidate], hosts: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """Return the candidates of a record, each endpoint once; a private one that a peer sees is listed twice.

    Host candidates with private addresses are tried between neighbouring networks only. In a large private network
    the peer may be further away, so it must see such an address as a reflexive one, too.

    Args:
        seen: as peers see this switch.
        hosts: addresses of devices.
    """
    reached = {(each.uplink, each.endpoint) for each in hosts if not each.endpoint.is_private}
    reflexive = {each for each in seen if (each.uplink, each.endpoint) not in reached}
    return (*public, *sorted(reflexive), *hosts)


class OwnEndpoints:
    """Publisher of a switch's endpoint record: a new one for each change of its candidates."""

    def __init__(self, *, config: LinksConfig, identity: Identity, switch: SwitchCore, tunnels: Tunnels) -> None:
        self._config = config
        self._identity = identity
        self._switch = switch
        self._tunnels = tunnels
        self._hosts: tuple[Candidate, ...] = ()
        self._hosts_s = float("-inf")
        self._monitor = AddressMonitor()
        self._published: EndpointRecord | None = None

    def publish_changes(self, now: Timestamps) -> None:
        """Publish a record if the candidates differ from the published ones, or the RIB keeps a later record."""
        if self._monitor.has_news() or now.mono_s >= self._hosts_s:
            self._hosts_s = now.mono_s + _ADDRESSES_PERIOD_S
            try:
                self._hosts = self._host_candidates()
            except LocalError as error:
                log.warning("own addresses not read, the former ones count on reason=%s", error)
        known, candidates = self._published, self._candidates()[:CANDIDATES_MAX]
        refusal = self._switch.tunnels.endpoints.refusal
        sequence = time.time_ns() // 1_000_000
        is_stale = refusal is not None and refusal.reason is DropReason.STALE
        kept_sequence = refusal.kept_sequence if refusal is not None and is_stale else 0
        if known is not None:
            is_same = (known.candidates, known.membership) == (candidates, self._identity.membership)
            if is_same and known.sequence > kept_sequence:
                return
            sequence = max(sequence, known.sequence + 1)
        sequence = max(sequence, kept_sequence + 1)
        record = own_record(self._identity, len(self._tunnels.underlays), candidates, sequence=sequence)
        try:
            self._switch.tunnels.publish_endpoints(record)
        except StatementError as error:
            log.error("endpoint record not published reason=%s", error)
            return
        self._published = record
        shown = ", ".join(f"{each.type.value} {each.endpoint.to_text()}" for each in record.candidates)
        log.info("endpoints published candidates=%s", shown or "none")

    def close(self) -> None:
        """Stop following the addresses of this host."""
        self._monitor.close()

    def _candidates(self) -> tuple[Candidate, ...]:
        public = public_candidates(self._config.public_endpoints(), len(self._tunnels.underlays))
        uplinks = {found.port: tunnel.uplink for tunnel, found in self._tunnels.all.items()}
        seen = (
            Candidate(uplinks[port], CandidateType.REFLEXIVE, endpoint)
            for (port, _), endpoint in self._switch.state.neighbours.observed_addresses().items()
            if port in uplinks
        )
        return listed_candidates(public, seen, self._hosts)

    def _host_candidates(self) -> tuple[Candidate, ...]:
        """Return the addresses of each uplink's device; without configured uplinks, those of all devices."""
        devices = self._config.uplinks or (None,)
        excluded = [device.ifname for device in self._tunnels.underlays]
        return tuple(
            Candidate(uplink, CandidateType.HOST, Endpoint(address, self._tunnels.underlays[uplink].listen_port))
            for uplink, ifname in enumerate(devices)
            for address in host_addresses(excluded, only=ifname)
        )
