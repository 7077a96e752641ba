"""Records of a channel: authenticated encryption under a key of one direction, with a number that never repeats.

Sans-I/O. Source: the record protocol of RFC 9147 (DTLS 1.3, section 4) reduced to what a channel needs: one algorithm,
AES-256-GCM-SIV (RFC 8452), and one epoch. The number is the nonce; a direction's key lives as long as its channel. A
machine resumed from a snapshot may use a number twice, as in ``control_seal``: that reveals only equality.
"""

from __future__ import annotations

from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCMSIV

from gdp.errors import DropReason, EnvelopeError

_NONCE_BYTES: Final = 12


class RecordKey:
    """The key of one direction; ``secret``: 32 bytes, known to both ends only."""

    __slots__ = ("_aead",)

    def __init__(self, secret: bytes) -> None:
        self._aead = AESGCMSIV(secret)

    def seal(self, number: int, head: bytes, plaintext: bytes) -> bytes:
        """Return ciphertext and tag. A number must be used once."""
        return self._aead.encrypt(number.to_bytes(_NONCE_BYTES, "big"), plaintext, head)

    def open(self, number: int, head: bytes, ciphertext: bytes) -> bytes:
        """Return the plaintext. Raises ``EnvelopeError``: BAD_TAG."""
        try:
            return self._aead.decrypt(number.to_bytes(_NONCE_BYTES, "big"), ciphertext, head)
        except InvalidTag as error:
            raise EnvelopeError(DropReason.BAD_TAG, "a record of a channel") from error
