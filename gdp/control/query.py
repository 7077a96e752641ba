"""A question to a RIB, and its answers: one for each advertiser of the name, or one that there is none.

Place: pure.
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
    """Who advertises ``name``? With ``watch_s`` above zero: and tell me of changes for so long.

    Args:
        revoked: digest of what the asker knows that the name's owner took back; the RIB sends all where its own
            differs. None: that does not concern the asker.
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
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        revoked = fields.bytes_("v", ID_BYTES) if "v" in fields and fields["v"] != b"" else None
        return cls(fields.name("n"), fields.number("w", 0, LEASE_MAX_S), revoked)


@dataclass(frozen=True, slots=True)
class Response:
    """One advertiser of a name, or none.

    Args:
        name: what was asked for.
        advertiser: who advertises it; equal to ``name`` with an empty ``claim`` when nobody does.
        claim: the advertiser's own signed claim, for the asker to verify; empty: it is gone, or nobody is there.
        domain: where it is attached.
        transit: domains through which that domain lets its traffic pass.
        lease_s: how long this may be believed.
        sequence: of the newest claim that is gone; whoever knows a newer one has heard an old answer.
    """

    name: Name
    advertiser: Name
    advertisement: bytes
    domain: Name
    transit: tuple[Name, ...]
    lease_s: float
    sequence: int = 0

    @property
    def is_nobody(self) -> bool:
        """Return whether this says that no one advertises the name."""
        return not self.advertisement and self.advertiser == self.name

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
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        return cls(
            fields.name("n"),
            fields.name("a"),
            fields.bytes_("q"),
            fields.name("d"),
            tuple(fields.names("x", TRANSIT_MAX)),
            fields.number("l", 0, LEASE_MAX_S),
            fields.uint("s"),
        )
