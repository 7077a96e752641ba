"""A short sealed note from one member of a topic to another, such as a reader's report; not signed.

Place: pure.
Source: DESIGN section 4. A note proves that its sender holds the topic's secret, no more: what depends on who wrote it
belongs in a message. Layout: ``header | topic (32) | ciphertext | tag``; additional data is the header without hops left
and the topic; the nonce is number || 0.
"""

from __future__ import annotations

import struct
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from gdp.crypto.envelope import TAG_BYTES, seal_key
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import HEADER_BYTES, Header, authenticated, encode
from gdp.frame.kinds import Flag
from gdp.limits import HOPS_MAX
from gdp.names import NAME_BYTES

__all__ = ["NoteOpener", "NoteSealer", "topic_of"]

_NONCE: Final = struct.Struct("!QI")
_BODY_AT: Final = HEADER_BYTES + NAME_BYTES


def topic_of(header: Header, frame: bytes) -> bytes:
    """Return the topic that a note is about; not yet authenticated.

    Raises:
        EnvelopeError: too short for one.
    """
    if header.length < NAME_BYTES + TAG_BYTES or header.parts != 1:
        raise EnvelopeError(DropReason.TRUNCATED, "note")
    return frame[HEADER_BYTES:_BODY_AT]


class NoteSealer:
    """Seals notes of one source's incarnation about one topic to one destination."""

    def __init__(
        self, secret: bytes, epoch: int, kind: int, source: bytes, incarnation: int, destination: bytes, topic: bytes
    ) -> None:
        self._aead = AESGCM(seal_key(secret, kind, source, incarnation, destination))
        self._header = Header(kind, Flag.LAST, HOPS_MAX, epoch, 0, 0, 0, 1, incarnation, destination, source)
        self._topic = topic
        self._number = 0

    def seal(self, body: bytes) -> bytes:
        """Return the frame of the next note."""
        self._number += 1
        length = NAME_BYTES + len(body) + TAG_BYTES
        header = encode(self._header._replace(number=self._number, length=length))
        sealed = self._aead.encrypt(_NONCE.pack(self._number, 0), body, authenticated(header) + self._topic)
        return header + self._topic + sealed


class NoteOpener:
    """Opens notes of one source's incarnation; an older note than the last is a replay."""

    def __init__(self, secret: bytes, kind: int, source: bytes, incarnation: int, destination: bytes) -> None:
        self._aead = AESGCM(seal_key(secret, kind, source, incarnation, destination))
        self._last = 0

    def open(self, header: Header, frame: bytes) -> bytes:
        """Return the note's body.

        Raises:
            EnvelopeError: altered, or not newer than the last.
        """
        if header.number <= self._last:
            raise EnvelopeError(DropReason.REPLAYED, "note")
        aad = authenticated(frame) + frame[HEADER_BYTES:_BODY_AT]
        try:
            body = self._aead.decrypt(
                _NONCE.pack(header.number, 0), frame[_BODY_AT : HEADER_BYTES + header.length], aad
            )
        except InvalidTag:
            raise EnvelopeError(DropReason.BAD_TAG, "note") from None
        self._last = header.number
        return body
