"""Sealing of control messages between members of a topic, such as a reader's AckNack; they are not signed.

Sans-I/O. Source: docs/explanation/design.md, section 4; AES-256-GCM-SIV (RFC 8452), HKDF (RFC 5869), X25519 (RFC 7748).
Layout: ``header | topic (32) | ciphertext | tag``. The nonce is number || 0. The additional data are the header without
its hops-left field, the topic, and the incarnation of the recipient.

The key of a control message belongs to one incarnation of each end. It is derived from the agreement of their two
X25519 keys and from the topic's secret. So a control message proves which reader wrote it, and that this reader has the
secret of the message's epoch. A copied process, such as two machines resumed from one snapshot, may use a number twice.
Under GCM-SIV that reveals only whether two control messages are equal.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESGCMSIV
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.burst.cipher import TAG_BYTES
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import (
    HEADER_BYTES,
    HOPS_AT,
    LENGTH_AT,
    NUMBER_AT,
    PACE_AT,
    PART_AT,
    Flag,
    Header,
    authenticated,
    encode,
)
from gdp.limits import HOPS_MAX
from gdp.names import NAME_BYTES

_INCARNATION: Final = struct.Struct("!Q")
_LENGTH_AND_NUMBER: Final = struct.Struct("!HQ")
# numbers between two messages that arrive together; the writer proxies of a reader share its numbers
JUMP_MAX: Final = 4_096
_NUMBERS_PER_S: Final = 100_000  # more than one process sends
_BODY_AT: Final = HEADER_BYTES + NAME_BYTES


class ControlContext(NamedTuple):
    """What a key is bound to: control messages about one topic from one node's incarnation to another's."""

    kind: int
    source: bytes
    incarnation: int
    destination: bytes
    destination_incarnation: int
    topic: bytes


def control_key(
    shared: bytes,
    secret: bytes,
    kind: int,
    source: bytes,
    incarnation: int,
    destination: bytes,
    destination_incarnation: int,
    topic: bytes,
) -> bytes:
    """Return the 32-byte key of control messages about one topic, from one node's incarnation to another's.

    Args:
        shared: the secret that the X25519 keys of both incarnations agree on.
        secret: topic secret of the epoch.
    """
    ends = source + _INCARNATION.pack(incarnation) + destination + _INCARNATION.pack(destination_incarnation)
    info = b"gdp-note-1" + bytes([kind]) + ends + topic
    return HKDF(algorithm=hashes.SHA256(), length=32, salt=secret, info=info).derive(shared)


def topic_of(header: Header, frame: bytes) -> bytes:
    """Return the topic of a control message; not yet authenticated. Raises ``EnvelopeError``: shorter than a topic."""
    if header.length < NAME_BYTES + TAG_BYTES or header.parts != 1:
        raise EnvelopeError(DropReason.TRUNCATED, "note")
    return frame[HEADER_BYTES:_BODY_AT]


class ControlSealer:
    """Seals the control messages of one context.

    Args:
        key: 32 bytes.
        numbers: rising, from 1 on, and one iterator for all sealers of the source's incarnation: some share a key.
    """

    def __init__(self, *, key: bytes, epoch: int, context: ControlContext, numbers: Iterator[int]) -> None:
        kind, source, incarnation, destination, destination_incarnation, topic = context
        self._aead = AESGCMSIV(key)
        self._header = encode(Header(kind, Flag.LAST, HOPS_MAX, epoch, 0, 0, 0, 1, incarnation, destination, source))
        self._topic = topic
        self._context = topic + _INCARNATION.pack(destination_incarnation)
        self._numbers = numbers

    def seal(self, body: bytes) -> bytes:
        """Return the frame of the next control message."""
        number = next(self._numbers)
        length = NAME_BYTES + len(body) + TAG_BYTES
        header = self._header[:LENGTH_AT] + _LENGTH_AND_NUMBER.pack(length, number) + self._header[PART_AT:]
        additional = header[:HOPS_AT] + header[HOPS_AT + 1 :] + self._context
        return header + self._topic + self._aead.encrypt(header[NUMBER_AT:PACE_AT], body, additional)


class ControlOpener:
    """Opens control messages under one key, whatever their numbers; ``ControlReplayWindow`` rejects replays."""

    def __init__(self, key: bytes, topic: bytes, destination_incarnation: int) -> None:
        self._aead = AESGCMSIV(key)
        self._context = topic + _INCARNATION.pack(destination_incarnation)

    def open(self, header: Header, frame: bytes) -> bytes:
        """Return the body of a control message. Raises ``EnvelopeError``: BAD_TAG, altered or under another key."""
        sealed = frame[_BODY_AT : HEADER_BYTES + header.length]
        try:
            return self._aead.decrypt(frame[NUMBER_AT:PACE_AT], sealed, authenticated(frame) + self._context)
        except (InvalidTag, ValueError):  # ValueError: shorter than a tag
            raise EnvelopeError(DropReason.BAD_TAG, "note") from None


class ControlReplayWindow:
    """Replay check for one source's incarnation: numbers must rise, and by no more than the elapsed time allows."""

    def __init__(self) -> None:
        self._last = 0
        self._last_s = 0.0

    def check(self, number: int, now_s: float) -> None:
        """Return if a control message of this number may be opened.

        Raises:
            EnvelopeError: REPLAYED, not newer than the last; MALFORMED, so far above it that no process counts so fast.
        """
        if number <= self._last:
            raise EnvelopeError(DropReason.REPLAYED, "note")
        if self._last and number - self._last > JUMP_MAX + max(now_s - self._last_s, 0.0) * _NUMBERS_PER_S:
            raise EnvelopeError(DropReason.MALFORMED, "a note far ahead of its time")

    def accept(self, number: int, now_s: float) -> None:
        """Record the number of an opened control message."""
        self._last, self._last_s = number, now_s
