"""What a RIB keeps of one advertisement.

Place: pure.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.limits import CLOCK_SKEW_S
from gdp.names import Name
from gdp.trust.advertisement import Advertisement

__all__ = ["Route", "Withdrawn"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """One advertiser of a name, verified.

    Args:
        sender: the switch or RIB that relayed the claim, whose quota it counts against.
        switch: where the advertiser is attached, as its RtCert says.
        domain: where that switch stands.
        via: the domain of ``sender``: another one where the claim came over several tiers.
        transit: domains through which that domain lets its traffic pass.
        claim: the signed bytes.
        is_from_above: learnt from the tier above, to be passed down only.
        expires_s: end of the lease, monotonic seconds.
        valid_until_unix_s: ``CLOCK_SKEW_S`` after the claim's evidence runs out; it cannot be played back after that.
        fingerprints: of that evidence; a revocation names one of them.
        issuers: keys that may revoke something of it, the domain's root apart.
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
    is_from_above: bool
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
        is_from_above: bool = False,
    ) -> Route:
        """Return what is kept of a verified claim."""
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
            is_from_above=is_from_above,
            expires_s=expires_s,
            valid_until_unix_s=advertisement.valid_until_unix_s + int(CLOCK_SKEW_S),
            fingerprints=advertisement.fingerprints,
            issuers=advertisement.issuers,
        )

    @property
    def place(self) -> tuple[Name, Name]:
        """Return what a move changes: switch and domain."""
        return self.switch, self.domain


@dataclass(frozen=True, slots=True)
class Withdrawn:
    """What stays of a withdrawn or expired advertisement: the sequence number that a new one must pass.

    It counts against its sender's quota like a route: else claiming and withdrawing in turn would fill the store.

    Args:
        proof: the signed withdrawal; empty for a lease that ended, which every RIB notices by itself.
        membership: of its maker, whose key signed it.
    """

    sender: Name
    sequence: int
    valid_until_unix_s: int
    proof: bytes = b""
    membership: bytes = b""
