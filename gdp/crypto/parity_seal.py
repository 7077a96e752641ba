"""Seal of parity frames, which repeat sealed frames of a message in coded form; they are not signed.

Sans-I/O. Source: AES-256-GCM-SIV (RFC 8452). Layout: ``header | ciphertext | tag``; the nonce is number || part, and
the additional data are the header without its hops-left field. The key is that of messages (``seal_key``) for the kind
of parity frames. The number is that of the message, and the part counts its parity frames. If a copied process uses a
nonce twice, GCM-SIV reveals only whether two bodies are equal.
"""

from __future__ import annotations

import struct
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCMSIV

from gdp.burst.cipher import TAG_BYTES
from gdp.crypto.envelope import seal_key
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import HEADER_BYTES, Flag, Header, Kind, authenticated, encode
from gdp.limits import HOPS_MAX

_NONCE: Final = struct.Struct("!QI")
_LAST: Final = int(Flag.LAST)


class ParitySealer:
    """Seals the parity frames of one source towards one destination, under one epoch's key.

    Args:
        secret: topic secret of the epoch, 32 bytes.
        address: the destination in the headers; None: ``destination``, which the key is bound to.
    """

    def __init__(
        self,
        *,
        secret: bytes,
        epoch: int,
        source: bytes,
        incarnation: int,
        destination: bytes,
        address: bytes | None = None,
    ) -> None:
        self._aead = AESGCMSIV(seal_key(secret, Kind.PARITY, source, incarnation, destination))
        to = destination if address is None else address
        self._header = Header(int(Kind.PARITY), 0, HOPS_MAX, epoch, 0, 0, 0, 1, incarnation, to, source)

    def seal(self, number: int, part: int, parts: int, flags: int, body: bytes, pace: int = 0) -> bytes:
        """Return the frame of a body.

        Args:
            part: count of the message's parity frames before it.
            parts: of the message.
            flags: of the message, as its ``pace``.
        """
        length = len(body) + TAG_BYTES
        header = self._header._replace(
            flags=flags & ~_LAST, length=length, number=number, part=part, parts=parts, pace=pace
        )
        head = encode(header)
        return head + self._aead.encrypt(_NONCE.pack(number, part), body, authenticated(head))


class ParityOpener:
    """Opens the parity frames of one source's incarnation, under one epoch's key."""

    def __init__(self, secret: bytes, source: bytes, incarnation: int, destination: bytes) -> None:
        self._aead = AESGCMSIV(seal_key(secret, Kind.PARITY, source, incarnation, destination))

    def open(self, header: Header, frame: bytes) -> bytes:
        """Return the body of a parity frame. Raises ``EnvelopeError``: BAD_TAG, altered or under another key."""
        sealed = frame[HEADER_BYTES : HEADER_BYTES + header.length]
        try:
            return self._aead.decrypt(_NONCE.pack(header.number, header.part), sealed, authenticated(frame))
        except (InvalidTag, ValueError):  # ValueError: shorter than a tag
            raise EnvelopeError(DropReason.BAD_TAG, "parity") from None
