"""Query to a RIB, and its responses: one for each advertiser of the name, one that there is none, or "unknown".

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.limits import LEASE_MAX_S
from gdp.names import Name
from gdp.trust.revocations import ID_BYTES

__all__ = ["Query", "Response"]

TRANSIT_MAX: Final = 64


@dataclass(frozen=True, slots=True)
class Query:
    """Query for the advertisers of ``name``; with ``watch_s`` above zero also a watch for that time.

    Args:
        revoked: digest of the revocations of the name's owner that the sender has; the RIB sends all if its own
            differs. None: revocations do not concern the sender.
    """

    name: Name
    watch_s: float
    revoked: bytes | None = None

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        body = {"n": self.name, "w": float(self.watch_s), "v": self.revoked or b"", "c": membership}
        return sign(StatementType.QUERY, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Query:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        revoked = fields.bytes_("v", ID_BYTES) if "v" in fields and fields["v"] != b"" else None
        return cls(fields.name("n"), fields.number("w", 0, LEASE_MAX_S), revoked)


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """One advertiser of a name, none, or unknown: the RIB could not ask the tier above.

    Args:
        advertiser: node that advertises it; equal to ``name`` with an empty ``advertisement`` when no node does, or the
            RIB does not know.
        advertisement: signed by the advertiser, for the receiver to verify; empty: it ended, or there is none.
        domain: where it is attached.
        transit: domains through which that domain lets its traffic pass.
        lease_s: of the location, or of a negative response; 0: the advertisement ended, or the RIB does not know.
        sequence: of the newest advertisement that ended; a receiver that knows a newer one ignores this response.
    """

    name: Name
    advertiser: Name
    advertisement: bytes
    domain: Name
    transit: tuple[Name, ...]
    lease_s: float
    sequence: int = 0

    @property
    def is_negative(self) -> bool:
        """Return whether no node advertises the name."""
        return not self.advertisement and self.advertiser == self.name and not self.is_unknown

    @property
    def is_unknown(self) -> bool:
        """Return whether the RIB could not ask those that would know."""
        return self.advertiser == self.name and not (self.advertisement or self.lease_s or self.sequence)

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        body = {
            "n": self.name,
            "a": self.advertiser,
            "q": self.advertisement,
            "d": self.domain,
            "x": list(self.transit[:TRANSIT_MAX]),
            "l": float(self.lease_s),
            "s": self.sequence,
            "c": membership,
        }
        return sign(StatementType.ANSWER, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Response:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        return cls(
            name=fields.name("n"),
            advertiser=fields.name("a"),
            advertisement=fields.bytes_("q"),
            domain=fields.name("d"),
            transit=tuple(fields.names("x", TRANSIT_MAX)),
            lease_s=fields.number("l", 0, LEASE_MAX_S),
            sequence=fields.uint("s"),
        )
