"""Plan of a switch's tunnels: which of its uplinks is joined to which uplink of a peer, and where to dial.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.control.endpoint_record import CandidateType, EndpointRecord
from gdp.control.endpoints import Endpoint
from gdp.names import Name

__all__ = ["DIAL_S", "Dialer", "TunnelId", "planned_tunnels", "tunnel_ifname", "underlay_ifname"]

DIAL_S: Final = 1.0  # one candidate is tried for this time before the next one
_DIGITS: Final = 11  # IFNAMSIZ - 1 less the prefix


class TunnelId(NamedTuple):
    """A tunnel of this switch.

    Attributes:
        peer: the switch at its far end.
        uplink: of this switch, from 0.
        peer_uplink: of the far end.
    """

    peer: Name
    uplink: int
    peer_uplink: int


def planned_tunnels(uplinks: int, record: EndpointRecord) -> list[TunnelId]:
    """Return the tunnels to a peer: each uplink of either end is used, and both ends come to the same pairs."""
    theirs = len(record.keys)
    pairs = [(min(index, uplinks - 1), min(index, theirs - 1)) for index in range(max(uplinks, theirs))]
    return [TunnelId(record.name, *pair) for pair in pairs]


def underlay_ifname(me: Name, uplink: int) -> str:
    """Return the name of the WireGuard device of an uplink, unique on a host that has several network namespaces."""
    return f"gw{uplink}-" + hashlib.sha256(b"gdp-underlay" + me).hexdigest()[:_DIGITS]


def tunnel_ifname(me: Name, tunnel: TunnelId) -> str:
    """Return the name of the VXLAN device of a tunnel."""
    own = b"gdp-tunnel" + me + tunnel.peer + bytes([tunnel.uplink, tunnel.peer_uplink])
    return f"gx{tunnel.uplink}-" + hashlib.sha256(own).hexdigest()[:_DIGITS]


@dataclass(slots=True)
class Dialer:
    """Choice of the endpoint that one tunnel dials.

    A border's public endpoints are tried in turn until its hellos arrive. A peer without one dials this switch.
    """

    endpoints: Sequence[Endpoint]
    index: int = -1
    since_s: float = float("-inf")

    @classmethod
    def to(cls, record: EndpointRecord, uplink: int) -> Dialer:
        """Return the dialer of a tunnel to one uplink of a peer."""
        public = (each for each in record.candidates if each.type is CandidateType.PUBLIC and each.uplink == uplink)
        return cls(tuple(each.endpoint for each in public))

    def next(self, now_s: float, *, is_up: bool) -> Endpoint | None:
        """Return the endpoint to dial now; None: go on as before."""
        if is_up:
            self.since_s = now_s
            return None
        if not self.endpoints or now_s < self.since_s + DIAL_S:
            return None
        self.index, self.since_s = (self.index + 1) % len(self.endpoints), now_s
        return self.endpoints[self.index]
