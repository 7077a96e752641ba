"""What became of a claim: taken, or refused and why.

Place: pure.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason
from gdp.names import Name

__all__ = ["AdvertiseAck"]


@dataclass(frozen=True, slots=True)
class AdvertiseAck:
    """A RIB's or a switch's answer to an advertisement or a withdrawal.

    Args:
        refused: None when it was taken.
        sequence: of the claim that the judge now holds: a refused STALE claim must be above it.
    """

    name: Name
    advertiser: Name
    refused: DropReason | None
    sequence: int

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement, shorter than any claim: a stranger's bytes are never multiplied."""
        body = {
            "n": self.name,
            "a": self.advertiser,
            "r": 255 if self.refused is None else int(self.refused),
            "s": self.sequence,
            "c": membership,
        }
        return sign(StatementType.ADVERTISE_ACK, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> AdvertiseAck:
        """Read a parsed statement's body; a reason of a later version reads as MALFORMED.

        Raises:
            StatementError: MALFORMED.
        """
        reason = fields.uint("r", 255)
        known = DropReason(reason) if reason in DropReason.__members__.values() else DropReason.MALFORMED
        return cls(fields.name("n"), fields.name("a"), None if reason == 255 else known, fields.uint("s"))
