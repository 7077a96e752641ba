"""Link-state database of a switch: the newest link state of each switch and scope.

Sans-I/O. Source: after RFC 2328, section 13.1 (which of two is newer) and 13.4 (a newer copy of one's own).

The number of a removed link state stays known for as long as any clock could accept its time (``PAST_S``). So a
recorded link state of a dead switch is rejected. Numbers are kept for each incarnation of an origin, so that a
restarted origin is accepted at once, whatever its clock shows.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Final

from gdp.control.hello import DIGEST_BYTES
from gdp.control.hello_port import HelloPort
from gdp.control.link_state import LinkState, Scope
from gdp.errors import DropReason, StatementError
from gdp.intervals import LINK_STATE
from gdp.limits import LINK_STATE_AGE_MAX_S
from gdp.names import Name

LINK_STATES_MAX = 8_192
PAST_S: Final = 2 * LINK_STATE_AGE_MAX_S  # a state signed by a fast clock stays valid this long at slow clocks
_INCARNATIONS_MAX: Final = (
    8  # incarnations of one origin that are tracked; above that, the highest number of all counts
)


@dataclass(slots=True)
class _Entry:
    state: LinkState
    wire: bytes
    expires_s: float


@dataclass(slots=True)
class _Past:
    """Past sequence numbers of one origin and scope."""

    until_s: float
    incarnation_ids: dict[bytes, int] = field(default_factory=dict)
    minimum: int = -1  # minimum for all incarnations that are not listed

    def record(self, incarnation_id: bytes, sequence: int, until_s: float) -> None:
        self.until_s = until_s
        self.incarnation_ids[incarnation_id] = max(sequence, self.incarnation_ids.pop(incarnation_id, -1))
        if len(self.incarnation_ids) > _INCARNATIONS_MAX:
            self.minimum = max(self.minimum, self.incarnation_ids.pop(next(iter(self.incarnation_ids))))


class LinkStateDatabase:
    """Link-state database of one switch.

    Attributes:
        version: rises with every change that may change a path or an identity conflict.
        losses: rises with those by which a link, a RIB or a switch is gone.
    """

    def __init__(self, domain: Name) -> None:
        self._domain = domain
        self._entries: dict[tuple[Name, Scope], _Entry] = {}
        self._digests: dict[bool, bytes] = {}
        self._past: dict[tuple[Name, Scope], _Past] = {}  # in order of their end
        self.version = self.losses = 0

    def __len__(self) -> int:
        return len(self._entries)

    def is_news(self, origin: Name, scope: Scope, sequence: int) -> bool:
        """Return whether a link state is newer than the present one."""
        known = self._entries.get((origin, scope))
        return known is None or sequence > known.state.sequence

    def is_past(self, origin: Name, scope: Scope, sequence: int, incarnation_id: bytes) -> bool:
        """Return whether a link state was removed or replaced before."""
        past = self._past.get((origin, scope))
        return past is not None and sequence <= past.incarnation_ids.get(incarnation_id, past.minimum)

    def sequence_of(self, origin: Name, scope: Scope) -> int:
        """Return the newest sequence number known, or 0."""
        known = self._entries.get((origin, scope))
        return 0 if known is None else known.state.sequence

    def put(self, state: LinkState, wire: bytes, now_s: float) -> bool:
        """Store a verified link state; return whether it was news.

        Raises:
            StatementError: QUOTA, the database is full.
        """
        key = (state.origin, state.scope)
        if not self.is_news(*key, state.sequence) or self.is_past(*key, state.sequence, state.incarnation_id):
            return False
        known = self._entries.get(key)
        if known is None and len(self._entries) >= LINK_STATES_MAX:
            raise StatementError(DropReason.QUOTA, "link states")
        if known is not None and known.state.incarnation_id != state.incarnation_id:
            self._bury(known.state, now_s)
        self._entries[key] = _Entry(state, wire, now_s + LINK_STATE.lease_s)
        self._digests.clear()
        if known is None or _ways(known.state) != _ways(state):
            self.version += 1
            self.losses += known is not None and not _reached(known.state) <= _reached(state)
        return True

    def expire(self, now_s: float) -> None:
        """Remove link states that were not renewed."""
        late = [key for key, entry in self._entries.items() if entry.expires_s <= now_s]
        for key in late:
            self._bury(self._entries.pop(key).state, now_s)
            self.version += 1
            self.losses += 1
        while self._past:
            key, past = next(iter(self._past.items()))
            if past.until_s > now_s:
                break
            del self._past[key]
        if late:
            self._digests.clear()

    def _bury(self, state: LinkState, now_s: float) -> None:
        key = state.origin, state.scope
        past = self._past.pop(key, None) or _Past(now_s)
        past.record(state.incarnation_id, state.sequence, now_s + PAST_S)
        self._past[key] = past
        if len(self._past) > 2 * LINK_STATES_MAX:
            del self._past[next(iter(self._past))]

    def next_expiry(self) -> float | None:
        """Return the monotonic second of the next expiry, or None."""
        return min((entry.expires_s for entry in self._entries.values()), default=None)

    def states(self, scope: Scope) -> list[LinkState]:
        """Return all link states of a scope."""
        return [entry.state for (_, its), entry in self._entries.items() if its is scope]

    def shared_with(self, domain: Name) -> list[bytes]:
        """Return the statements that a neighbour of this domain should have."""
        return [entry.wire for key, entry in self._entries.items() if self._is_shared(key, domain)]

    def digest(self, domain: Name) -> bytes:
        """Return a short digest of the states shared with a neighbour of this domain; equal at both when in step."""
        is_home = domain == self._domain
        digest = self._digests.get(is_home)
        if digest is None:
            lines = sorted(
                origin + scope.value.encode() + entry.state.sequence.to_bytes(8, "big")
                for (origin, scope), entry in self._entries.items()
                if self._is_shared((origin, scope), domain)
            )
            digest = self._digests[is_home] = hashlib.sha256(b"".join(lines)).digest()[:DIGEST_BYTES]
        return digest

    def digest_for(self, port: HelloPort) -> bytes:
        """Return the digest for a hello on a port: nothing where its switches are of several domains."""
        domains = {each.domain for each in port.neighbours.values() if each.role.is_switch}
        return self.digest(domains.pop()) if len(domains) == 1 else bytes(DIGEST_BYTES)

    def _is_shared(self, key: tuple[Name, Scope], domain: Name) -> bool:
        return key[1] is Scope.BORDER or domain == self._domain


def _ways(state: LinkState) -> tuple[object, ...]:
    return state.links, state.inside, state.ribs, state.members, state.incarnation_id, state.refused, state.is_leaf


def _reached(state: LinkState) -> set[tuple[Name, int]]:
    """Return the links, the paths inside the domain, the RIBs and the switches that a state names."""
    paths = {(each.name, each.key) for each in (*state.links, *state.inside)}
    return paths | {(each.name, -1) for each in state.ribs} | {(name, -1) for name in state.members}
