"""A short sealed note from one member of a topic to another, such as a reader's report; not signed.

Place: pure.
Source: DESIGN section 4. A note proves that its sender holds the topic's secret, no more: what depends on who wrote it
belongs in a message. Layout: ``header | topic (32) | ciphertext | tag``; the nonce is number || 0; additional data is
the header without hops left, the topic, and the incarnation of the one it is for, so that a note is worth nothing to a
later life of the same node.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
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
_INCARNATION: Final = struct.Struct("!Q")
JUMP_MAX: Final = 1 << 16  # numbers between two notes that one opener sees; a reader's feeds share its numbers
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
    """Seals notes of one source's incarnation about one topic to one incarnation of a destination.

    Args:
        numbers: rising, from 1 on, and one iterator for all sealers of the source's incarnation: the key does not tell
            two sealers to one destination apart, so their nonces must.
    """

    def __init__(
        self,
        secret: bytes,
        epoch: int,
        kind: int,
        source: bytes,
        incarnation: int,
        destination: bytes,
        topic: bytes,
        destination_incarnation: int,
        numbers: Iterator[int],
    ) -> None:
        self._aead = AESGCM(seal_key(secret, kind, source, incarnation, destination))
        self._header = Header(kind, Flag.LAST, HOPS_MAX, epoch, 0, 0, 0, 1, incarnation, destination, source)
        self._topic = topic
        self._context = topic + _INCARNATION.pack(destination_incarnation)
        self._numbers = numbers

    def seal(self, body: bytes) -> bytes:
        """Return the frame of the next note."""
        number = next(self._numbers)
        length = NAME_BYTES + len(body) + TAG_BYTES
        header = encode(self._header._replace(number=number, length=length))
        sealed = self._aead.encrypt(_NONCE.pack(number, 0), body, authenticated(header) + self._context)
        return header + self._topic + sealed


class NoteOpener:
    """Opens notes of one source's incarnation about one topic; an older note than the last is a replay."""

    def __init__(
        self,
        secret: bytes,
        kind: int,
        source: bytes,
        incarnation: int,
        destination: bytes,
        topic: bytes,
        destination_incarnation: int,
    ) -> None:
        self._aead = AESGCM(seal_key(secret, kind, source, incarnation, destination))
        self._context = topic + _INCARNATION.pack(destination_incarnation)
        self._last = 0

    def open(self, header: Header, frame: bytes) -> bytes:
        """Return the note's body.

        Raises:
            EnvelopeError: altered, or not newer than the last.
        """
        if header.number <= self._last:
            raise EnvelopeError(DropReason.REPLAYED, "note")
        if self._last and header.number > self._last + JUMP_MAX:
            raise EnvelopeError(DropReason.MALFORMED, "a note far ahead of its time")
        sealed = frame[_BODY_AT : HEADER_BYTES + header.length]
        try:
            body = self._aead.decrypt(_NONCE.pack(header.number, 0), sealed, authenticated(frame) + self._context)
        except InvalidTag:
            raise EnvelopeError(DropReason.BAD_TAG, "note") from None
        self._last = header.number
        return body
