"""What attached nodes claim through this switch, and whether the RIB has taken it.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.names import Name
from gdp.trust.claim import Claim
from gdp.trust.right import Right

__all__ = ["Attached", "Attachment"]

RELAY_AGAIN_S: Final = 0.4
RELAY_TRIES: Final = 20


@dataclass(slots=True)
class Attachment:
    """One claim of one attached node."""

    claim: Claim
    port: int
    mac: bytes
    expires_s: float
    relay_at_s: float
    tries: int = 0
    is_settled: bool = False  # the RIB has answered


class Attached:
    """The claims of all attached nodes, by (name, advertiser)."""

    def __init__(self) -> None:
        self._by_name: dict[Name, dict[Name, Attachment]] = {}
        self._next_s = float("inf")  # nothing is due before

    def __len__(self) -> int:
        return sum(map(len, self._by_name.values()))

    def get(self, name: Name, advertiser: Name) -> Attachment | None:
        """Return a claim, or None."""
        return self._by_name.get(name, {}).get(advertiser)

    def at(self, name: Name) -> Attachment | None:
        """Return an attachment that takes unicast frames for a name, or None."""
        for attachment in self._by_name.get(name, {}).values():
            if attachment.claim.right in (Right.ATTACH, Right.SERVE):
                return attachment
        return None

    def put(self, claim: Claim, port: int, mac: bytes, now_s: float) -> Attachment:
        """Note a verified claim; it is to be relayed at once."""
        attachment = Attachment(claim, port, mac, now_s + claim.lease_s, now_s)
        self._by_name.setdefault(claim.name, {})[claim.node] = attachment
        self._next_s = min(self._next_s, now_s)
        return attachment

    def remove(self, name: Name, advertiser: Name) -> Attachment | None:
        """Forget a claim; return it, if it was there."""
        claims = self._by_name.get(name, {})
        gone = claims.pop(advertiser, None)
        if not claims:
            self._by_name.pop(name, None)
        return gone

    def all(self) -> list[Attachment]:
        """Return every claim."""
        return [each for claims in self._by_name.values() for each in claims.values()]

    def of(self, advertiser: Name) -> list[Attachment]:
        """Return all claims of one node."""
        return [claims[advertiser] for claims in self._by_name.values() if advertiser in claims]

    def settle(self, name: Name, advertiser: Name, taken: int | None) -> Attachment | None:
        """Note that the RIB has answered; return the claim.

        Args:
            taken: the sequence number that it took, if it did: what was claimed anew since is not settled by that.
        """
        attachment = self.get(name, advertiser)
        if attachment is None or (taken is not None and taken < attachment.claim.sequence):
            return None
        attachment.is_settled = True
        return attachment

    def relay_all(self, now_s: float) -> None:
        """Have everything relayed again: there is a new RIB."""
        for claims in self._by_name.values():
            for attachment in claims.values():
                attachment.is_settled, attachment.relay_at_s, attachment.tries = False, now_s, 0
        self._next_s = min(self._next_s, now_s)

    def due(self, now_s: float) -> list[Attachment]:
        """Return the claims to relay now."""
        if now_s < self._next_s:
            return []
        due = []
        for claims in self._by_name.values():
            for each in claims.values():
                if not each.is_settled and each.relay_at_s <= now_s and each.tries < RELAY_TRIES:
                    each.tries += 1
                    each.relay_at_s = now_s + RELAY_AGAIN_S
                    due.append(each)
        self._look_ahead()
        return due

    def expire(self, now_s: float) -> list[Attachment]:
        """Forget and return what was not renewed."""
        if now_s < self._next_s:
            return []
        late = [each for claims in self._by_name.values() for each in claims.values() if each.expires_s <= now_s]
        for each in late:
            self.remove(each.claim.name, each.claim.node)
        return late

    def next_event(self) -> float | None:
        """Return a monotonic second that is no later than the next relay or lease end, or None."""
        return self._next_s if self._by_name else None

    def next_expiry(self) -> float | None:
        """Return the monotonic second of the next lease end, or None; looks at all."""
        ends = (each.expires_s for claims in self._by_name.values() for each in claims.values())
        return min(ends, default=None)

    def _look_ahead(self) -> None:
        times = [
            each.expires_s if each.is_settled or each.tries >= RELAY_TRIES else min(each.relay_at_s, each.expires_s)
            for claims in self._by_name.values()
            for each in claims.values()
        ]
        self._next_s = min(times, default=float("inf"))
