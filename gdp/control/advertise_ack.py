"""Acknowledgement of an advertisement: accepted, or rejected with a reason.

Sans-I/O.
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
    """Reply of a RIB or a switch to an advertisement or a withdrawal.

    Args:
        refused: None when it was accepted.
        sequence: of the advertisement that the sender now holds; one refused as STALE must be resent with a higher
            number.
    """

    name: Name
    advertiser: Name
    refused: DropReason | None
    sequence: int

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement; shorter than any advertisement, it is useless for amplification."""
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
        """Read a parsed statement's body; a reason of a later version is read as MALFORMED.

        Raises:
            StatementError: MALFORMED.
        """
        reason = fields.uint("r", 255)
        known = DropReason(reason) if reason in DropReason.__members__.values() else DropReason.MALFORMED
        return cls(fields.name("n"), fields.name("a"), None if reason == 255 else known, fields.uint("s"))
