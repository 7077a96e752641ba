"""Store of a RIB's routes: the interface, and the embedded store in memory.

Sans-I/O. Leases, other RIBs of the domain (``replication.py``) or a snapshot refill it after a restart.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator
from typing import Protocol

from gdp.control.rib_replication import Key
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_set import SyncSet
from gdp.names import Name
from gdp.rib.route import Route, Withdrawn
from gdp.sansio import Timestamps
from gdp.trust.evidence_index import EvidenceIndex


class Store(Protocol):
    """Routes by name and advertiser.

    Every method may raise ``StoreError``: the caller may try again.
    """

    @property
    def digests(self) -> SyncSet[int] | None:
        """Return hashes over the contents, for replication; None where several RIBs share the store itself."""

    def __len__(self) -> int:
        """Return how many routes are stored."""

    def prefetch(self, names: Collection[Name], now: Timestamps) -> None:
        """Prefetch the entries that the next calls concern, all in one go."""

    def commit(self) -> list[Key]:
        """End a turn of changes; return the keys whose change was not accepted, which a later statement may repeat."""

    def routes(self, name: Name) -> list[Route]:
        """Return a name's routes."""

    def get(self, name: Name, advertiser: Name) -> Route | Withdrawn | None:
        """Return what is known of one advertiser of a name."""

    def put(self, route: Route) -> None:
        """Add or replace a route."""

    def withdraw(self, name: Name, advertiser: Name, withdrawn: Withdrawn | None = None) -> Route | None:
        """Remove a route and return it; store ``withdrawn``, by default its sequence number."""

    def expire(self, now_s: float, unix_s: float) -> list[Route]:
        """Remove and return the routes whose lease ended; their sequence numbers stay."""

    def next_expiry(self) -> float | None:
        """Return the monotonic second of the next lease end, or None."""

    def count_of(self, owner: Name) -> int:
        """Return how many routes are stored that a sender relayed, or a node advertises.

        Withdrawn ones that have not expired count too.
        """

    def resting_on(self, mark: bytes) -> list[Route]:
        """Return the routes whose evidence includes a certificate, by its fingerprint, or one that a key issued."""

    def has_issuer(self, key: bytes) -> bool:
        """Return whether a route depends on a certificate that this key, 33 bytes, issued."""


def check_quota(store: Store, names_max: int, sender: Name, node: Name) -> None:
    """Return if sender and node may have another name; a node gets at most as many as the sender has left.

    Raises:
        StatementError: QUOTA.
    """
    free = names_max - store.count_of(sender)
    if free <= 0:
        raise StatementError(DropReason.QUOTA, "names of one sender")
    if store.count_of(node) >= free:
        raise StatementError(DropReason.QUOTA, "names of one node")


class MemoryStore:
    """Routes in dictionaries; lease ends in a heap whose stale items are skipped."""

    def __init__(self) -> None:
        self._routes: dict[Name, dict[Name, Route]] = {}
        self._withdrawn: dict[tuple[Name, Name], Withdrawn] = {}
        self._counts = Counter[Name]()
        self._ends: list[tuple[float, Name, Name]] = []
        self._forget: list[tuple[int, Name, Name]] = []
        self._size = 0
        self._evidence = EvidenceIndex[Key]()
        self.changes: set[Key] | None = None  # what changed since the last snapshot; None: there are no snapshots
        # over the replicated entries: all but those from the tier above, and leases that ended
        self.digests = SyncSet[int](lambda rank: rank)

    def __len__(self) -> int:
        return self._size

    def known(self) -> Iterator[Key]:
        """Yield the name and advertiser of each route and of each withdrawal that has not expired."""
        yield from ((name, advertiser) for name, routes in self._routes.items() for advertiser in routes)
        yield from self._withdrawn

    def prefetch(self, names: Collection[Name], now: Timestamps) -> None:
        """Do nothing: everything is in memory."""

    def commit(self) -> list[Key]:
        """Return nothing: memory accepts every change."""
        return []

    def routes(self, name: Name) -> list[Route]:
        """Return a name's routes."""
        return list(self._routes.get(name, {}).values())

    def get(self, name: Name, advertiser: Name) -> Route | Withdrawn | None:
        """Return what is known of one advertiser of a name."""
        route = self._routes.get(name, {}).get(advertiser)
        return route if route is not None else self._withdrawn.get((name, advertiser))

    def put(self, route: Route) -> None:
        """Add or replace a route."""
        self._remove(route.name, route.advertiser)
        self._forget_withdrawn(route.name, route.advertiser)
        if self.changes is not None:
            self.changes.add((route.name, route.advertiser))
        if not route.is_from_upstream:
            self.digests.put(route.name + route.advertiser, route.rank)
        self._routes.setdefault(route.name, {})[route.advertiser] = route
        self._evidence.put((route.name, route.advertiser), route.fingerprints | route.issuers)
        self._counts.update((route.sender, route.advertiser))
        self._size += 1
        heapq.heappush(self._ends, (route.expires_s, route.name, route.advertiser))

    def withdraw(self, name: Name, advertiser: Name, withdrawn: Withdrawn | None = None) -> Route | None:
        """Remove a route and return it; store ``withdrawn``, by default its sequence number."""
        route = self._remove(name, advertiser)
        if withdrawn is None:
            if route is None:
                return None
            withdrawn = Withdrawn(route.sender, route.sequence, route.valid_until_unix_s)
        if self.changes is not None:
            self.changes.add((name, advertiser))
        self._forget_withdrawn(name, advertiser)
        self._withdrawn[name, advertiser] = withdrawn
        self._counts.update((withdrawn.sender, advertiser))
        heapq.heappush(self._forget, (withdrawn.valid_until_unix_s, name, advertiser))
        if withdrawn.proof:
            self.digests.put(name + advertiser, withdrawn.rank)
        return route

    def expire(self, now_s: float, unix_s: float) -> list[Route]:
        """Remove and return the routes whose lease ended; their sequence numbers stay."""
        gone = []
        while self._ends and self._ends[0][0] <= now_s:
            _, name, advertiser = heapq.heappop(self._ends)
            route = self._routes.get(name, {}).get(advertiser)
            if route is not None and route.expires_s <= now_s:
                self.withdraw(name, advertiser)
                gone.append(route)
        while self._forget and self._forget[0][0] <= unix_s:
            _, name, advertiser = heapq.heappop(self._forget)
            withdrawn = self._withdrawn.get((name, advertiser))
            if withdrawn is not None and withdrawn.valid_until_unix_s <= unix_s:
                self._forget_withdrawn(name, advertiser)
                if self.changes is not None:
                    self.changes.add((name, advertiser))
        return gone

    def next_expiry(self) -> float | None:
        """Return a monotonic second that is no later than the next lease end, or None."""
        return self._ends[0][0] if self._ends else None

    def count_of(self, owner: Name) -> int:
        """Return how many routes are stored that a sender relayed, or a node advertises."""
        return self._counts[owner]

    def resting_on(self, mark: bytes) -> list[Route]:
        """Return the routes whose evidence includes a certificate, by its fingerprint, or one that a key issued."""
        return [self._routes[name][advertiser] for name, advertiser in self._evidence.resting_on(mark)]

    def has_issuer(self, key: bytes) -> bool:
        """Return whether a route depends on a certificate that this key, 33 bytes, issued."""
        return self._evidence.has(key)

    def _remove(self, name: Name, advertiser: Name) -> Route | None:
        of_name = self._routes.get(name, {})
        route = of_name.pop(advertiser, None)
        if route is None:
            return None
        if not of_name:
            del self._routes[name]
        self._evidence.remove((name, advertiser), route.fingerprints | route.issuers)
        self._size -= 1
        self._uncount(route.sender, advertiser)
        self.digests.remove(name + advertiser)
        return route

    def _forget_withdrawn(self, name: Name, advertiser: Name) -> None:
        withdrawn = self._withdrawn.pop((name, advertiser), None)
        if withdrawn is not None:
            self._uncount(withdrawn.sender, advertiser)
            self.digests.remove(name + advertiser)

    def _uncount(self, *owners: Name) -> None:
        for owner in owners:
            self._counts[owner] -= 1
            if not self._counts[owner]:
                del self._counts[owner]
