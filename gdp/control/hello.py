"""What neighbours say to each other over a link, again and again.

Place: pure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.limits import FRAME_MAX_BYTES
from gdp.names import Name

__all__ = ["DIGEST_BYTES", "NONCE_BYTES", "Hello"]

NONCE_BYTES: Final = 8
DIGEST_BYTES: Final = 8
HEARD_MAX: Final = 32


@dataclass(frozen=True, slots=True)
class Hello:
    """One greeting on one port.

    Args:
        nonce: random for this session of the sender's port; to be echoed, which proves that the neighbour is there now.
        sequence: rises within the session.
        heard: the nonces of those that the sender hears on this port.
        mtu: bytes after the Ethernet header that the sender's port takes.
        digest: of the link state that both ends should share; where it differs, they send each other all of it.
        membership: the sender's certificate, DER.
    """

    nonce: bytes
    sequence: int
    heard: tuple[bytes, ...]
    mtu: int
    digest: bytes
    membership: bytes

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "n": self.nonce,
            "s": self.sequence,
            "h": list(self.heard[:HEARD_MAX]),
            "m": self.mtu,
            "d": self.digest,
            "c": self.membership,
        }
        return sign(StatementType.HELLO, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Hello:
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        return cls(
            fields.bytes_("n", NONCE_BYTES),
            fields.uint("s"),
            tuple(fields.byte_strings("h", HEARD_MAX, NONCE_BYTES)),
            fields.uint("m", FRAME_MAX_BYTES),
            fields.bytes_("d", DIGEST_BYTES),
            fields.bytes_("c"),
        )
