"""Name cache: the locations of names that RIBs and neighbours proved, and negative entries.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). While no RIB responds, an entry is served beyond its lease,
until the proofs of its advertisement end themselves (RFC 8767 in spirit). Where a RIB responds but does not know a
name, its entries get another lease within that time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gdp.intervals import ADVERTISEMENT, NEGATIVE_LEASE_S
from gdp.names import Name
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import Right


@dataclass(frozen=True, slots=True, kw_only=True)
class Location:
    """One advertiser of a name, and where it is attached."""

    name: Name
    advertiser: Name
    right: Right
    switch: Name
    domain: Name
    transit: frozenset[Name]  # domains through which that domain lets its traffic pass
    advertisement: bytes
    expires_s: float
    proof: Advertisement | None = None  # what was verified; None in tests that build a location directly
    stale_until_s: float = 0.0  # end of the proofs: it is served until then while no RIB responds
    source: tuple[Name, bytes] | None = None  # the RIB that gave it, and that RIB's session; None: a switch did

    @property
    def sequence(self) -> int:
        """Return the sequence number of the advertisement, or 0."""
        return 0 if self.proof is None else self.proof.sequence


class NameCache:
    """The locations that one switch knows, and negative entries.

    Args:
        lease_s: of an advertisement; when a RIB responds again, it has half of that to confirm stale entries.

    Attributes:
        serves_stale: no RIB responds, so entries outlive their leases.
    """

    def __init__(self, lease_s: float = ADVERTISEMENT.lease_s) -> None:
        self._lease_s = lease_s
        self._confirm_s = lease_s / 2
        self._locations: dict[Name, dict[Name, Location]] = {}
        self._names_of: dict[Name, set[Name]] = {}  # what each advertiser advertises, of ``_places``
        self._negative: dict[Name, float] = {}
        self._expire_at_s = float("inf")  # no lease ends before
        self.serves_stale = False

    def __len__(self) -> int:
        return len(self._locations)

    def of(self, name: Name, now_s: float) -> list[Location]:
        """Return the known locations of a name."""
        known = self._locations.get(name)
        return [] if known is None else [location for location in known.values() if self._ends_s(location) > now_s]

    def get(self, name: Name, advertiser: Name) -> Location | None:
        """Return the location of one advertiser of a name, or None."""
        return self._locations.get(name, {}).get(advertiser)

    def of_node(self, node: Name, now_s: float) -> Location | None:
        """Return the newest location of any name that a node advertises, where the node is attached, or None."""
        known = (self._locations[name][node] for name in self._names_of.get(node, ()))
        held = [location for location in known if self._ends_s(location) > now_s]
        return max(held, key=lambda location: location.sequence, default=None)

    def all(self) -> list[Location]:
        """Return every location."""
        return [location for known in self._locations.values() for location in known.values()]

    def is_negative(self, name: Name, now_s: float) -> bool:
        """Return whether the RIB recently sent a negative response for the name."""
        return self._negative.get(name, 0.0) > now_s

    def put(self, location: Location) -> Location | None:
        """Store a location; return what was known of this advertiser before."""
        self._negative.pop(location.name, None)
        known = self._locations.setdefault(location.name, {})
        before = known.get(location.advertiser)
        known[location.advertiser] = location
        self._names_of.setdefault(location.advertiser, set()).add(location.name)
        self._expire_at_s = min(self._expire_at_s, self._ends_s(location))
        return before

    def remove(self, name: Name, advertiser: Name) -> None:
        """Remove one advertiser of a name; nothing happens where it is not known."""
        known = self._locations.get(name, {})
        if known.pop(advertiser, None) is None:
            return
        if not known:
            del self._locations[name]
        names = self._names_of[advertiser]
        names.discard(name)
        if not names:
            del self._names_of[advertiser]

    def put_negative(self, name: Name, now_s: float) -> None:
        """Replace the entries of a name by a negative entry, for ``NEGATIVE_LEASE_S``."""
        for advertiser in list(self._locations.get(name, ())):
            self.remove(name, advertiser)
        self._negative[name] = now_s + NEGATIVE_LEASE_S
        self._expire_at_s = min(self._expire_at_s, now_s + NEGATIVE_LEASE_S)

    def extend(self, name: Name, now_s: float) -> None:
        """Give the entries of a name another lease, up to the end of their proofs: the RIB does not know the name."""
        for advertiser, location in self._locations.get(name, {}).items():
            until_s = max(location.expires_s, min(now_s + self._lease_s, location.stale_until_s))
            self._locations[name][advertiser] = replace(location, expires_s=until_s)

    def serve_stale(self, stale: bool, now_s: float) -> None:
        """Begin or end to serve entries beyond their leases.

        When a RIB responds again, entries that it does not confirm within half a lease expire.
        """
        if stale == self.serves_stale:
            return
        self.serves_stale = stale
        if not stale:
            for known in self._locations.values():
                for advertiser, location in known.items():
                    if location.expires_s < now_s + self._confirm_s < location.stale_until_s:
                        known[advertiser] = replace(location, expires_s=now_s + self._confirm_s)
        self._find_next()

    def expire(self, now_s: float) -> list[Location]:
        """Remove entries whose leases have ended; return the locations among them."""
        if now_s < self._expire_at_s:
            return []
        gone = [location for location in self.all() if self._ends_s(location) <= now_s]
        for location in gone:
            self.remove(location.name, location.advertiser)
        for name in [name for name, until_s in self._negative.items() if until_s <= now_s]:
            del self._negative[name]
        self._find_next()
        return gone

    def next_expiry(self) -> float | None:
        """Return a monotonic second that is no later than the next expiry, or None."""
        return None if self._expire_at_s == float("inf") else self._expire_at_s

    def _find_next(self) -> None:
        ends = [self._ends_s(location) for known in self._locations.values() for location in known.values()]
        self._expire_at_s = min([*ends, *self._negative.values()], default=float("inf"))

    def _ends_s(self, location: Location) -> float:
        return max(location.expires_s, location.stale_until_s) if self.serves_stale else location.expires_s
