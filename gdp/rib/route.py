"""Route: the stored form of one advertisement in a RIB."""

from __future__ import annotations

from dataclasses import dataclass

from gdp.control.rib_replication import Entry, Key
from gdp.intervals import LEASE_MAX_S
from gdp.limits import CLOCK_SKEW_S
from gdp.names import Name
from gdp.trust.advertisement import Advertisement


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """One advertiser of a name, verified.

    Args:
        sender: the switch or RIB that relayed the advertisement, and whose quota it uses.
        switch: where the advertiser is attached, from its RtCert.
        domain: the domain of that switch.
        via: the domain of ``sender``: another one where the advertisement came over several tiers.
        transit: domains through which that domain lets its traffic pass.
        advertisement: the signed bytes.
        is_from_upstream: learnt from the tier above, and sent downwards only.
        expires_s: end of the lease, monotonic seconds.
        valid_until_unix_s: ``CLOCK_SKEW_S`` after the advertisement's evidence expires; no replay is possible after
            that.
        fingerprints: of that evidence; a revocation names one of them.
        issuers: keys that may revoke part of it, apart from the domain's root.
    """

    name: Name
    advertiser: Name
    sender: Name
    switch: Name
    domain: Name
    via: Name
    transit: tuple[Name, ...]
    sequence: int
    is_global: bool
    advertisement: bytes
    is_from_upstream: bool
    expires_s: float
    valid_until_unix_s: int
    fingerprints: frozenset[bytes]
    issuers: frozenset[bytes] = frozenset()

    @classmethod
    def of(
        cls,
        advertisement: Advertisement,
        *,
        sender: Name,
        domain: Name,
        via: Name,
        transit: tuple[Name, ...],
        expires_s: float,
        is_from_upstream: bool = False,
    ) -> Route:
        """Return the route of a verified advertisement."""
        return cls(
            name=advertisement.name,
            advertiser=advertisement.node,
            sender=sender,
            switch=advertisement.switch,
            domain=domain,
            via=via,
            transit=transit,
            sequence=advertisement.sequence,
            is_global=advertisement.is_global,
            advertisement=advertisement.wire,
            is_from_upstream=is_from_upstream,
            expires_s=expires_s,
            valid_until_unix_s=advertisement.valid_until_unix_s + int(CLOCK_SKEW_S),
            fingerprints=advertisement.fingerprints,
            issuers=advertisement.issuers,
        )

    @property
    def key(self) -> Key:
        """Return the key under which it is stored and replicated."""
        return self.name, self.advertiser

    @property
    def place(self) -> tuple[Name, Name]:
        """Return what a move changes: switch and domain."""
        return self.switch, self.domain

    @property
    def rank(self) -> int:
        """Return a rank that is higher for the newer of two entries: by sequence number, then the withdrawal."""
        return 2 * self.sequence

    def to_entry(self, _own: Name, now_s: float) -> Entry | None:
        """Return what a peer receives; None: the lease ended."""
        if self.expires_s <= now_s:
            return None
        return Entry(
            statement=self.advertisement,
            membership=b"",
            sender=self.sender,
            domain=self.domain,
            via=self.via,
            transit=self.transit,
            lease_s=min(self.expires_s - now_s, LEASE_MAX_S),
            is_from_upstream=self.is_from_upstream,
        )


@dataclass(frozen=True, slots=True)
class Withdrawn:
    """What remains of a withdrawn or expired advertisement: the sequence number that a new one must exceed.

    It uses its sender's quota like a route; otherwise, alternate advertisements and withdrawals would fill the store.

    Args:
        proof: the signed withdrawal; empty for a lease that ended, which every RIB detects by itself.
        membership: of its maker, whose key signed it.
    """

    sender: Name
    sequence: int
    valid_until_unix_s: int
    proof: bytes = b""
    membership: bytes = b""

    @property
    def rank(self) -> int:
        """Return its rank, as of a route; a lease that ended ranks like the advertisement."""
        return 2 * self.sequence + bool(self.proof)

    def to_entry(self, own: Name, _now_s: float) -> Entry | None:
        """Return what a peer of domain ``own`` receives; None: a lease that ended."""
        if not self.proof:
            return None
        return Entry(
            statement=self.proof,
            membership=self.membership,
            sender=self.sender,
            domain=own,
            via=own,
            transit=(),
            lease_s=0.0,
            is_from_upstream=False,
            until_unix_s=self.valid_until_unix_s,
        )
