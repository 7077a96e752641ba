"""Cipher of one message, which seals and opens many of its parts in one call; the twin in Python.

Sans-I/O. Source: NIST SP 800-38D (GCM); ``frame/spec.md`` gives each byte. From part to part only the number changes::

    header        version kind flags hops | epoch length number PART parts incarnation destination source | salt
    additional    version kind flags      | the same as far as the source
    nonce                                                number PART
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import islice
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from gdp.frame.codec import FLAGS_AT, HEADER_BYTES, HOPS_AT, LENGTH_AT, NUMBER_AT, PART_AT, PARTS_AT, authenticated
from gdp.frame.kinds import Flag
from gdp.sansio import ReceivedFrame

__all__ = ["BODY_AT", "SALT_BYTES", "TAG_BYTES", "MessageCipher"]

SALT_BYTES: Final = 8
TAG_BYTES: Final = 16
BODY_AT: Final = HEADER_BYTES + SALT_BYTES  # of the ciphertext in a frame
_LENGTH: Final = struct.Struct("!H")
_PART: Final = struct.Struct("!I")
_LAST: Final = int(Flag.LAST)


class MessageCipher:
    """Cipher under the key of one message, AES-256-GCM.

    A *head* is the header of any part of the message, without ``Flag.LAST``, and the salt.
    """

    def __init__(self, key: bytes) -> None:
        self._aead = AESGCM(key)

    def seal(
        self, head: bytes, first: int, end: int, message: bytes, capacity: int, signature_bytes: int, /
    ) -> tuple[list[bytes], bytes]:
        """Return the frames of the parts ``first`` to ``end``, and their ciphertexts with tags if they are signed.

        Args:
            message: whole; each part but the last two carries ``capacity`` bytes of it.
            signature_bytes: that the caller appends to the last frame; 0: the message is not signed.
        """
        frames: list[bytes] = []
        payloads: list[bytes] = []
        header, additional, size = bytearray(head), bytearray(), -1
        encrypt, last = self._aead.encrypt, int.from_bytes(head[PARTS_AT : PARTS_AT + 4], "big") - 1
        for part in range(first, end):
            plain, is_last = message[part * capacity : (part + 1) * capacity], part == last
            if len(plain) != size or is_last:
                size = len(plain)
                header[FLAGS_AT] = head[FLAGS_AT] | _LAST * is_last
                _LENGTH.pack_into(header, LENGTH_AT, SALT_BYTES + size + TAG_BYTES + signature_bytes * is_last)
                additional = header[:HOPS_AT] + header[HOPS_AT + 1 : HEADER_BYTES]
            _PART.pack_into(header, PART_AT, part)
            _PART.pack_into(additional, PART_AT - 1, part)
            payloads.append(encrypt(header[NUMBER_AT:PARTS_AT], plain, additional))
            frames.append(b"".join((header, payloads[-1])))
        return frames, b"".join(payloads) if signature_bytes else b""

    def open(self, frame: bytes, end: int, /) -> tuple[bytes, bytes] | None:
        """Return plaintext, and ciphertext with tag, of a part whose tag ends at ``end``; None: it was altered."""
        payload = frame[BODY_AT:end]
        try:
            return self._aead.decrypt(frame[NUMBER_AT:PARTS_AT], payload, authenticated(frame)), payload
        except InvalidTag:
            return None

    def open_run(
        self, head: bytes, length: int, first: int, count: int, arrivals: Sequence[ReceivedFrame], at: int,
        wants_payloads: bool, /,
    ) -> tuple[int, bytes, bytes]:  # fmt: skip
        """Open at most ``count`` consecutive parts from ``first`` on, in ``arrivals[at:]``.

        A frame that does not begin, to the bit, as its part should ends the run, as does an altered one.

        Args:
            length: payload bytes of each part, none of which is the last.

        Returns:
            how many parts were opened; their plaintexts; and if wanted their ciphertexts with tags.
        """
        plains: list[bytes] = []
        payloads: list[bytes] = []
        decrypt, end, nonce = self._aead.decrypt, HEADER_BYTES + length, head[NUMBER_AT:PART_AT]
        before, behind = head[:LENGTH_AT] + _LENGTH.pack(length) + head[NUMBER_AT:PART_AT], head[PARTS_AT:]
        additional_behind = head[PARTS_AT:HEADER_BYTES]
        additional = before[:HOPS_AT] + before[HOPS_AT + 1 :]
        for part, arrival in zip(range(first, first + count), islice(arrivals, at, None), strict=False):
            frame, number = arrival.frame, part.to_bytes(4, "big")
            if not frame.startswith(before + number + behind):
                break
            payload = frame[BODY_AT:end]
            try:
                plains.append(decrypt(nonce + number, payload, additional + number + additional_behind))
            except InvalidTag:
                break
            payloads.append(payload)
        return len(plains), b"".join(plains), b"".join(payloads) if wants_payloads else b""
