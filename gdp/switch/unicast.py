"""Unicast forwarding: resolve a name's location, install the path, release pending frames.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

An entry is keyed by the destination alone where one domain is concerned, and by destination and source where the path
leaves it: then only domains that the policies of both ends trust may carry the frame.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.crypto.certificates import Role
from gdp.errors import DropReason
from gdp.frame.codec import DESTINATION_AT, HEADER_BYTES, HOPS_AT
from gdp.intervals import LINK_STATE, NEGATIVE_LEASE_S
from gdp.names import NAME_BYTES, Name
from gdp.sansio import OutgoingFrames
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.name_cache import Location
from gdp.switch.paths import Path
from gdp.switch.table import NOWHERE, Hop, ProtectedHop

STALE_S: Final = 5.0  # an entry for a location whose lease has ended, while no RIB responds
_REFRESH_AT_ONCE: Final = 4_096  # paths; about 50 ms


@dataclass(frozen=True, slots=True)
class _Installed:
    """Why an entry stands, to be checked again when links change."""

    destination: Name
    source: Name
    nowhere: DropReason | None = None  # why it leads nowhere

    @property
    def is_negative(self) -> bool:
        """Return whether it leads nowhere."""
        return self.nowhere is not None


class Unicast:
    """Resolves and installs the paths of frames to one name."""

    def __init__(self, state: ForwardingState) -> None:
        self._state = state
        self._own_domain = state.policy.own
        self._transit = state.policy.transit
        self._installed: dict[bytes, _Installed] = {}
        self._stale = deque[bytes]()  # keys of paths to compute again
        self._keys_of: dict[Name, set[bytes]] = {}  # of what is installed, by destination
        self.drops: Counter[DropReason] = Counter()

    def forward(
        self, destination: Name, source: Name, frames: Sequence[bytes], now_s: float, owner: bytes = b""
    ) -> Name | None:
        """Send frames without a table entry on, or keep them until the query for a name is answered.

        Args:
            frames: each with the hops that are left when it has left this switch.
            owner: the neighbour that sent them, as ``owner_of``; empty: this switch.

        Returns:
            The name whose location the frames wait for, if any.
        """
        waits_for = self._resolve(destination, source, owner, now_s)
        if waits_for is None:
            self._send(self._hop(destination, source), frames)
        else:
            for frame in frames:
                self._state.resolver.buffer_frame(waits_for, frame, now_s, owner)
        return waits_for

    def send(self, frames: list[bytes], destination: Name, source: Name, now_s: float) -> None:
        """Send frames of our own to a name, by the same path as forwarded frames."""
        if self._resolve(destination, source, b"", now_s) is None:
            self._send(self._hop(destination, source), frames)

    def send_statement(self, kind: int, statement: bytes, destination: Name, now_s: float) -> None:
        """Send a statement of our own to a node that may be beyond a neighbour."""
        mtu = min((port.mtu for port in self._state.neighbours.ports.values()), default=1_500)
        frames = self._state.outbox.fragmenter.split(kind, statement, mtu, destination)
        self.send(frames, destination, self._state.me, now_s)

    def release(self, name: Name, now_s: float) -> None:
        """Resolve the paths that frames wait for with a name, as the policies are now; the frames leave by them."""
        pending = self._state.resolver.pending.release(name)
        for (names, owner), frames in groupby(pending, lambda f: (f.frame[DESTINATION_AT:HEADER_BYTES], f.owner)):
            destination, source = Name(names[:NAME_BYTES]), Name(names[NAME_BYTES:])
            waits_for = self._resolve(destination, source, owner, now_s)
            if waits_for is None:
                self._send(self._hop(destination, source), [each.frame for each in frames])
            else:
                for each in frames:
                    self._state.resolver.buffer_frame(waits_for, each.frame, now_s, owner, each.until_s)

    def refresh(self, now_s: float) -> None:
        """Compute every installed path again after a link change; ``refresh_more`` does the rest of very many."""
        self._stale = deque(self._installed)
        self.refresh_more(now_s)

    def refresh_more(self, now_s: float) -> None:
        """Continue ``refresh``, a slice at a time, so that a node is not busy with it for long."""
        for _ in range(min(len(self._stale), _REFRESH_AT_ONCE)):
            key = self._stale.popleft()
            why = self._installed.get(key)
            if why is None:
                continue
            if not why.is_negative:  # a negative entry is resolved again when the next frame comes
                self._resolve(why.destination, why.source, b"", now_s)
            if self._installed.get(key) is why:  # no other entry replaced it
                self._uninstall(key)

    @property
    def is_refreshing(self) -> bool:
        """Return whether ``refresh_more`` has work left."""
        return bool(self._stale)

    def remove(self, *names: Name) -> None:
        """Remove the entries to names whose location has changed, negative ones included."""
        for name in names:
            for key in list(self._keys_of.get(name, ())):
                self._uninstall(key)

    def entry_removed(self, key: bytes) -> _Installed | None:
        """Forget an entry that is not in the table any more; return why it stood there, if it was one of these."""
        why = self._installed.pop(key, None)
        if why is not None:
            keys = self._keys_of[why.destination]
            keys.discard(key)
            if not keys:
                del self._keys_of[why.destination]
        return why

    def _uninstall(self, key: bytes) -> None:
        """Remove an entry of ours, but not a tree that may have replaced a negative one."""
        why = self.entry_removed(key)
        if why is not None and (not why.is_negative or self._state.table.entries.get(key) == NOWHERE):
            self._state.table.remove(key)

    def _note(self, key: bytes, why: _Installed) -> None:
        self.entry_removed(key)
        self._installed[key] = why
        self._keys_of.setdefault(why.destination, set()).add(key)

    def _hop(self, destination: Name, source: Name) -> Hop | DropReason:
        """Return the hop of the entry for such frames, or why it leads nowhere."""
        entries = self._state.table.entries
        if hops := entries.get(destination + source) or entries.get(destination):
            return hops[0][:2]
        why = self._installed.get(destination + source)
        return DropReason.NO_ROUTE if why is None or why.nowhere is None else why.nowhere

    def _send(self, hop: Hop | DropReason, frames: Sequence[bytes]) -> None:
        """Send frames that state the hops left behind this switch."""
        if isinstance(hop, DropReason):
            self.drops[hop] += len(frames)
            return
        alive = [frame for frame in frames if frame[HOPS_AT]]
        if len(alive) < len(frames):
            self.drops[DropReason.HOPS_EXPIRED] += len(frames) - len(alive)
        if alive:
            self._state.outbox.waiting.append(OutgoingFrames(hop[0], hop[1][:6], alive))

    def _resolve(self, destination: Name, source: Name, owner: bytes, now_s: float) -> Name | None:
        """Install an entry, perhaps a negative one; or return the name whose location must be queried first.

        Args:
            owner: the neighbour whose query rate applies; empty: our own.
        """
        at = self._state.attached.at(destination)
        if at is not None:
            self._install(destination, b"", self._state.neighbours.hop(at.port, at.mac), source, at.expires_s)
            return None
        neighbour = self._state.neighbours.cheapest(destination)
        # a proxy is where its advertisement was accepted
        if neighbour is not None and neighbour.role is not Role.PROXY:
            hop = self._state.neighbours.hop(neighbour.port, neighbour.mac)
            self._install(destination, b"", hop, source, now_s + LINK_STATE.refresh_s)
            return None
        if self._state.paths.is_switch(destination):
            domain = self._state.paths.domain_of(destination) or self._own_domain
            way = self._state.paths.to_switch(destination, domain, self._transit | {domain})
            otherwise = self._why(destination, domain)
            self._install_way(destination, b"", way, source, now_s + LINK_STATE.refresh_s, now_s, otherwise)
            return None
        if self._state.paths.is_rib(destination):
            way, _ = self._state.paths.to_rib(destination, self._transit)
            self._install_way(destination, b"", way, source, now_s + LINK_STATE.refresh_s, now_s)
            return None
        return self._resolve_by_rib(destination, source, owner, now_s)

    def _resolve_by_rib(self, destination: Name, source: Name, owner: bytes, now_s: float) -> Name | None:
        found = self._state.resolver.resolve(destination, now_s, owner)
        if found is None:
            return destination
        if isinstance(found, DropReason):
            self._install_negative(destination, source, found, now_s)
            return None
        if all(place.domain == self._own_domain for place in found) and self._is_of_own_domain(source, now_s):
            best = self._nearest(found, frozenset({self._own_domain}), now_s)
            if best is not None:
                self._install_way(destination, b"", best[0], source, best[1], now_s)
                return None
        transit = self._transit
        paths = self._state.paths
        if not (self._state.attached.at(source) or paths.is_switch(source) or paths.is_rib(source)):
            origin = self._state.resolver.resolve_any(source, now_s, owner)
            if origin is None:
                return source
            if isinstance(origin, DropReason):
                self._install_negative(destination, source, origin, now_s)
                return None
            transit = origin[0].transit | {origin[0].domain}
        best = self._nearest(found, transit & self._transit, now_s)
        if best is None:
            reasons = [self._why(place.switch, place.domain) for place in found]
            self._install_negative(destination, source, max(reasons, default=DropReason.NO_ROUTE), now_s)
        else:
            self._install_way(destination, source, best[0], source, best[1], now_s)
        return None

    def path_to(self, place: Location, allowed: frozenset[Name]) -> Path | None:
        """Return the path to a location on another switch through allowed domains, or None."""
        return self._state.paths.to_switch(place.switch, place.domain, allowed & place.transit | {place.domain})

    def _why(self, switch: Name, domain: Name) -> DropReason:
        """Return the reason to report where there is no path to a switch."""
        return DropReason.THROUGH_LEAF if self._state.paths.leads_through_leaf(switch, domain) else DropReason.NO_ROUTE

    def _is_of_own_domain(self, source: Name, now_s: float) -> bool:
        if self._state.attached.at(source) is not None or self._state.paths.domain_of(source) == self._own_domain:
            return True
        places = self._state.resolver.cache.of(source, now_s)
        return bool(places) and all(place.domain == self._own_domain for place in places)

    def _nearest(self, takers: list[Location], allowed: frozenset[Name], now_s: float) -> tuple[Path, float] | None:
        """Return the path to the nearest location, and how long its entry stands; a stale one is checked again soon."""
        ways = [(place, way) for place in takers if (way := self.path_to(place, allowed))]
        if not ways:
            return None
        best, way = min(ways, key=lambda each: (each[1].distance, each[0].advertiser))
        return way, max(best.expires_s, now_s + STALE_S)

    def _install_way(
        self,
        destination: Name,
        source_key: bytes,
        path: Path | None,
        source: Name,
        expires_s: float,
        now_s: float,
        otherwise: DropReason = DropReason.NO_ROUTE,
    ) -> None:
        """Install a path; where there is none, a negative entry with the reason ``otherwise``."""
        neighbour = None if path is None else self._state.neighbours.cheapest(path.first)
        if path is None or neighbour is None:
            self._install_negative(destination, source, otherwise, now_s)
        else:
            self._install(destination, source_key, self._protected_hop(neighbour, path.alternate), source, expires_s)

    def _protected_hop(self, neighbour: Neighbour, alternate: Name | None) -> Hop | ProtectedHop:
        """Return the hop to a neighbour with an alternate: over a second link to it, or else through ``alternate``."""
        neighbours = self._state.neighbours
        hop = neighbours.hop(neighbour.port, neighbour.mac)
        others = [port for port in neighbours.ports if port != neighbour.port]
        for name in (neighbour.name, alternate or neighbour.name):
            if found := [n for port in others if (n := neighbours.get(port, name)) is not None]:
                second = min(found, key=lambda n: (n.cost, n.port))
                return *hop, *neighbours.hop(second.port, second.mac)
        return hop

    def _install(
        self, destination: Name, source_key: bytes, hop: Hop | ProtectedHop, source: Name, expires_s: float
    ) -> None:
        key = destination + source_key
        negative = self._installed.get(destination + source)
        if negative is not None and negative.is_negative:
            self._uninstall(destination + source)  # the longer key would match first
        if self._state.table.install(key, (hop,), expires_s):
            self._note(key, _Installed(destination, source))

    def _install_negative(self, destination: Name, source: Name, reason: DropReason, now_s: float) -> None:
        """Make the data plane drop such frames briefly, unless a tree stands there."""
        key = destination + source
        if not self._state.table.entries.get(key) and self._state.table.install(key, NOWHERE, now_s + NEGATIVE_LEASE_S):
            self._note(key, _Installed(destination, source, reason))
