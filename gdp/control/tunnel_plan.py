"""Plan of a switch's tunnels: which of its uplinks is joined to which uplink of a peer, and where to dial."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.control.endpoints import UPLINKS_MAX, CandidateType, Endpoint, EndpointRecord
from gdp.names import Name
from gdp.requests import Backoff

DIAL_S: Final = 1.0  # one candidate is tried for this time before the next one
REBINDS: Final = Backoff(1.0, 30.0)  # between two other UDP ports of an uplink
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


UNDERLAY_PREFIXES: Final = tuple(f"gw{uplink}-" for uplink in range(UPLINKS_MAX))


def underlay_ifname(me: Name, uplink: int) -> str:
    """Return the name of the WireGuard device of an uplink, unique on a host that has several network namespaces."""
    return UNDERLAY_PREFIXES[uplink] + hashlib.sha256(b"gdp-underlay" + me).hexdigest()[:_DIGITS]


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

    def next(
        self, now_s: float, *, is_up: bool, has_route: Callable[[Endpoint], bool] = lambda _: True
    ) -> Endpoint | None:
        """Return the endpoint to dial now; None: go on as before.

        Args:
            has_route: whether this host can send to an endpoint; others are left out.
        """
        if is_up:
            self.since_s = now_s
            return None
        if not self.endpoints or now_s < self.since_s + DIAL_S:
            return None
        for step in range(1, len(self.endpoints) + 1):
            index = (self.index + step) % len(self.endpoints)
            if has_route(self.endpoints[index]):
                self.index, self.since_s = index, now_s
                return self.endpoints[index]
        return None


@dataclass(slots=True)
class RebindSchedule:
    """When an uplink takes another UDP port, because none of the borders answers any more, and no other tunnel is up.

    A NAT may have changed its address and kept its mappings. Keepalives then keep a mapping alive that leads nowhere;
    only packets from another port get a new one. Source: RFC 4787, section 4.3, on refresh by outbound packets.
    Another tunnel that is up proves that the NAT passes packets, and needs its mapping: its peer knows no other one.
    """

    was_up: bool = False
    due_s: float = float("inf")
    pause_s: float = REBINDS.first_s

    def update(self, now_s: float, *, is_up: bool, is_held: bool = False) -> bool:
        """Take in which tunnels over the uplink are up; return whether to take another port now.

        Args:
            is_up: one to a border.
            is_held: any other one. If it outlived the borders and is lost later, it has the longest pause to come back.
        """
        if is_up or not self.was_up:
            self.was_up, self.due_s, self.pause_s = self.was_up or is_up, float("inf"), REBINDS.first_s
            return False
        if self.due_s == float("inf"):
            self.due_s = now_s + self.pause_s
        if is_held and (now_s >= self.due_s or self.pause_s == REBINDS.most_s):
            self.pause_s, self.due_s = REBINDS.most_s, now_s + REBINDS.most_s
        if now_s < self.due_s:
            return False
        self.pause_s = REBINDS.after_s(self.pause_s)
        self.due_s = now_s + self.pause_s
        return True
