"""Cipher of one message, which seals and opens many of its parts in one call, and the buffer of its plaintext.

Sans-I/O; the twins in Python. Source: NIST SP 800-38D (GCM); ``frame/spec.md`` gives each byte. From part to part only
the number changes::

    header        version kind flags hops | epoch length number PART parts incarnation destination source | salt
    additional    version kind flags      | the same as far as the source
    nonce                                                number PART
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from itertools import count, islice
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from gdp.frame.codec import (
    FLAGS_AT,
    HEADER_BYTES,
    HOPS_AT,
    INCARNATION_AT,
    LENGTH_AT,
    NUMBER_AT,
    PACE_AT,
    PART_AT,
    PARTS_AT,
    Flag,
)
from gdp.sansio import ReceivedFrame

SALT_BYTES: Final = 8
TAG_BYTES: Final = 16
BODY_AT: Final = HEADER_BYTES + SALT_BYTES  # of the ciphertext in a frame
_LENGTH: Final = struct.Struct("!H")
_PART: Final = struct.Struct("!I")
_LAST: Final = int(Flag.LAST)


class Plaintext(list[bytes]):
    """Plaintext of a message that is opened part by part.

    Its argument is how many bytes the message has at most. The compiled twin reserves no more ahead than it may need.
    """

    def __init__(self, _expected: int, /) -> None:
        super().__init__()

    def collect(self) -> bytes:
        """Remove and return all of it."""
        whole = b"".join(self)
        self.clear()
        return whole


class MessageCipher:
    """Cipher under the key of one message, AES-256-GCM.

    A *head* is the header of any part of the message, without ``Flag.LAST``, and the salt. What a signature covers of
    each part, ciphertext and tag, is also fed to ``running``; None: the message is not signed.
    """

    def __init__(self, key: bytes) -> None:
        self._aead = AESGCM(key)

    def seal(
        self, head: bytes, first: int, end: int, prefix: bytes, message: bytes, capacity: int, signature_bytes: int,
        running: hashlib._Hash | None, /,
    ) -> list[bytes]:  # fmt: skip
        """Return the frames of the parts ``first`` to ``end``.

        Args:
            prefix: of the plaintext, no longer than a part; ``message`` follows, and is whole.
            capacity: bytes of plaintext that each part but the last two carries.
            signature_bytes: that the caller appends to the last frame.
        """
        frames: list[bytes] = []
        header, additional, size = bytearray(head), bytearray(), -1
        encrypt, last = self._aead.encrypt, int.from_bytes(head[PARTS_AT:INCARNATION_AT], "big") - 1
        for part, at in zip(range(first, end), count(first * capacity - len(prefix), capacity), strict=False):
            plain = message[at : at + capacity] if part else (prefix + message[:capacity])[:capacity]
            _PART.pack_into(header, PART_AT, part)
            length, is_last = len(plain), part == last
            if length != size or is_last:
                size = length
                header[FLAGS_AT] = head[FLAGS_AT] | _LAST * is_last
                _LENGTH.pack_into(header, LENGTH_AT, SALT_BYTES + size + TAG_BYTES + signature_bytes * is_last)
                additional = header[:HOPS_AT] + header[HOPS_AT + 1 : HEADER_BYTES]
            else:
                _PART.pack_into(additional, PART_AT - 1, part)
            payload = encrypt(header[NUMBER_AT:PACE_AT], plain, additional)
            frames.append(bytes(header) + payload)
            if running is not None:
                running.update(payload)
        return frames

    def open(self, frame: bytes, end: int, /) -> tuple[bytes, bytes] | None:
        """Return plaintext, and ciphertext with tag, of a part whose tag ends at ``end``; None: it was altered."""
        payload = frame[BODY_AT:end]
        try:
            additional = frame[:HOPS_AT] + frame[HOPS_AT + 1 : HEADER_BYTES]
            return self._aead.decrypt(frame[NUMBER_AT:PACE_AT], payload, additional), payload
        except InvalidTag:
            return None

    def open_run(
        self, head: bytes, length: int, first: int, parts: int, arrivals: Sequence[ReceivedFrame], at: int,
        running: hashlib._Hash | None, plaintext: Plaintext, /,
    ) -> int:  # fmt: skip
        """Open at most ``parts`` consecutive parts from ``first`` on, in ``arrivals[at:]``; return how many.

        A frame that does not begin, to the bit, as its part should ends the run, as does an altered one.

        Args:
            length: payload bytes of each part, none of which is the last.
            plaintext: to which that of the parts is appended.
        """
        plains: list[bytes] = []
        payloads: list[bytes] = []
        decrypt, end, nonce = self._aead.decrypt, HEADER_BYTES + length, head[NUMBER_AT:PART_AT]
        before, behind = head[:LENGTH_AT] + _LENGTH.pack(length) + head[NUMBER_AT:PART_AT], head[PACE_AT:]
        additional_behind = head[PACE_AT:HEADER_BYTES]
        additional = before[:HOPS_AT] + before[HOPS_AT + 1 :]
        for part, arrival in zip(range(first, first + parts), islice(arrivals, at, None), strict=False):
            frame, number = arrival.frame, part.to_bytes(4, "big")
            if not frame.startswith(before + number + behind):
                break
            payload = frame[BODY_AT:end]
            try:
                plains.append(decrypt(nonce + number, payload, additional + number + additional_behind))
            except InvalidTag:
                break
            payloads.append(payload)
        plaintext.append(b"".join(plains))
        if running is not None:
            running.update(b"".join(payloads))
        return len(payloads)
