"""Key agreement between two neighbours for one pair of sessions.

Sans-I/O. Source: X25519, RFC 7748; HKDF-SHA256, RFC 5869. Both public keys are part of signed hellos, which binds the
agreed key to the neighbour. A private key lives as long as a session of a port.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import x25519
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.errors import DropReason, StatementError

EXCHANGE_KEY_BYTES: Final = 32
_SECRET_BYTES: Final = 32


@dataclass(frozen=True, slots=True)
class ExchangeKey:
    """An ephemeral X25519 key. An agreement costs about 0.1 ms."""

    private: x25519.X25519PrivateKey = field(repr=False)
    public: bytes

    @classmethod
    def from_random(cls, random: bytes) -> ExchangeKey:
        """Make a key of 32 random bytes."""
        private = x25519.X25519PrivateKey.from_private_bytes(random)
        raw = serialization.Encoding.Raw, serialization.PublicFormat.Raw
        return cls(private, private.public_key().public_bytes(*raw))

    def agree(self, far_public: bytes, *purposes: bytes) -> list[bytes]:
        """Return one 32-byte secret for each purpose, shared only with the holder of the other key.

        Raises:
            StatementError: MALFORMED, the other key is invalid, or its secret would be publicly known.
        """
        try:
            shared = self.private.exchange(x25519.X25519PublicKey.from_public_bytes(far_public))
        except ValueError as error:
            raise StatementError(DropReason.MALFORMED, "an exchange key of the wrong form") from error
        return [HKDF(hashes.SHA256(), _SECRET_BYTES, None, purpose).derive(shared) for purpose in purposes]
