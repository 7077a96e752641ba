"""Sealing a message into frames, and opening its parts one by one.

Place: pure; no clock, no memory of messages (that is ``gdp/message``).
Source: DESIGN section 4; NIST SP 800-38D (GCM), RFC 5869 (HKDF), FIPS 186-5 (ECDSA). To the byte: ``frame/spec.md``.

::

    part 0            part 1                  last part
    header|c0|tag     header|c1|tag    ...    header|cn|tag|signature

Each part is AES-256-GCM under a key that belongs to (topic secret, kind, source, incarnation, destination); the nonce
is message number || part, the additional data the header without hops left. The signature covers SHA-256 over the
header fields that all parts share and every payload (ciphertext and tag) in order.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from itertools import islice
from typing import Final, Protocol, overload

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.heads import Heads
from gdp.effects import Arrival
from gdp.errors import DropReason, EnvelopeError, LocalError
from gdp.frame.codec import HEADER_BYTES, Header, authenticated, encode
from gdp.frame.kinds import VERSION, Flag
from gdp.limits import FRAME_MAX_BYTES, HOPS_MAX, MESSAGE_MAX_BYTES, PARTS_MAX, SEQUENCE_BYTES

__all__ = ["SIGNATURE_BYTES", "TAG_BYTES", "Opener", "Sealed", "Sealer", "Signer", "digest_of", "part_room", "seal_key"]

TAG_BYTES: Final = 16
SIGNATURE_BYTES: Final = 64
SECRET_BYTES: Final = 32
_NONCE: Final = struct.Struct("!QI")
_COMMON: Final = struct.Struct("!BBBHQIQ32s32s")
_LAST: Final = int(Flag.LAST)  # a plain number: an IntFlag's operators cost a microsecond each


class Signer(Protocol):
    """What the envelope needs of a writer's private key."""

    def sign_digest(self, digest: bytes) -> bytes:
        """Return 64 bytes, r || s, over a SHA-256 digest."""


def seal_key(secret: bytes, kind: int, source: bytes, incarnation: int, destination: bytes) -> bytes:
    """Return the 32-byte AES key of one source's incarnation towards one destination.

    A restarted source has a new incarnation, hence a new key: no nonce can come twice under one key, whatever crashed.

    Args:
        secret: topic secret of the epoch, 32 bytes.
    """
    if len(secret) != SECRET_BYTES:
        raise LocalError(f"a topic secret has {SECRET_BYTES} bytes, not {len(secret)}")
    info = b"gdp-seal-1" + bytes([kind]) + source + incarnation.to_bytes(8, "big") + destination
    return HKDF(algorithm=hashes.SHA256(), length=32, salt=None, info=info).derive(secret)


def part_room(mtu: int) -> int:
    """Return the plaintext bytes that one part carries where links take ``mtu`` bytes after the Ethernet header."""
    room = min(mtu, FRAME_MAX_BYTES) - HEADER_BYTES - TAG_BYTES
    if room <= SIGNATURE_BYTES:
        raise LocalError(f"an MTU of {mtu} bytes carries no sealed part")
    return room


def digest_of(header: Header) -> hashlib._Hash:
    """Return the running SHA-256 of a message, fed with the header fields that all its parts share."""
    return hashlib.sha256(
        b"gdp-message-1"
        + _COMMON.pack(
            VERSION,
            header.kind,
            header.flags & ~_LAST,
            header.epoch,
            header.number,
            header.parts,
            header.incarnation,
            header.destination,
            header.source,
        )
    )


class Sealer:
    """Seals one kind of message of one source towards one destination, under one epoch's key."""

    def __init__(
        self, secret: bytes, epoch: int, kind: int, source: bytes, incarnation: int, destination: bytes, signer: Signer
    ) -> None:
        self._aead = AESGCM(seal_key(secret, kind, source, incarnation, destination))
        self._signer = signer
        self._fixed = (epoch, kind, incarnation, destination, source)
        self._last_number = -1

    def seal(self, number: int, flags: int, message: bytes, mtu: int) -> Sealed:
        """Return a message as its frames, each from the header on and at most ``mtu`` bytes long.

        A part is encrypted when its frame is first asked for, so that the first ones may be on their way before the
        last ones are sealed.

        Args:
            number: message number; above every number this sealer was given before.
            flags: without ``Flag.LAST``.

        Raises:
            LocalError: a number that is not newer (its nonces would come twice), or a message above the limits.
        """
        if number <= self._last_number:
            raise LocalError(f"message number {number} was sealed before")
        size = len(message)
        room = part_room(mtu)
        parts = -(-(size + SIGNATURE_BYTES) // room)
        if size > MESSAGE_MAX_BYTES + SEQUENCE_BYTES or parts > PARTS_MAX:
            raise LocalError(f"a message of {size} bytes in {parts} parts is above the limit")
        self._last_number = number
        epoch, kind, incarnation, destination, source = self._fixed
        header = Header(kind, flags, HOPS_MAX, epoch, 0, number, 0, parts, incarnation, destination, source)
        return Sealed(self._aead, self._signer, header, message, room)


class Sealed(Sequence[bytes]):
    """The frames of one message, sealed in order and as far as they have been asked for; always the same bytes."""

    def __init__(self, aead: AESGCM, signer: Signer, header: Header, message: bytes, room: int) -> None:
        self._aead = aead
        self._encrypt = aead.encrypt
        self._signer = signer
        self._header = header
        self._message = memoryview(message)
        self._room = room
        self._running = digest_of(header)
        self._frames: list[bytes] = []
        self.size_bytes = len(message) + header.parts * (HEADER_BYTES + TAG_BYTES) + SIGNATURE_BYTES

    def __len__(self) -> int:
        return self._header.parts

    @overload
    def __getitem__(self, at: int) -> bytes: ...

    @overload
    def __getitem__(self, at: slice) -> list[bytes]: ...

    def __getitem__(self, at: int | slice) -> bytes | list[bytes]:
        parts = self._header.parts
        end = at.indices(parts)[1] if isinstance(at, slice) else at % parts + 1 if -parts <= at < parts else parts
        if end > len(self._frames):
            self._seal_until(end)
        return self._frames[at]

    @property
    def largest(self) -> int:
        """Return the bytes of the largest frame, sealed or not."""
        return self.size_bytes if self._header.parts == 1 else self._room + HEADER_BYTES + TAG_BYTES

    def message(self) -> bytes:
        """Return what was sealed, to be sealed anew under another number."""
        if len(self._frames) < self._header.parts:
            return bytes(self._message)
        last, number, decrypt = self._header.parts - 1, self._header.number, self._aead.decrypt
        plains = [
            decrypt(
                _NONCE.pack(number, part),
                frame[HEADER_BYTES : -SIGNATURE_BYTES if part == last else None],
                authenticated(frame),
            )
            for part, frame in enumerate(self._frames)
        ]
        return b"".join(plains)

    def _seal_until(self, end: int) -> None:
        full_end = min(end, self._header.parts - 2)  # the last two may be shorter
        if len(self._frames) < full_end:
            self._seal_full(full_end)
        for part in range(len(self._frames), end):
            self._seal_one(part)

    def _seal_full(self, end: int) -> None:
        """Seal the parts before ``end``, all of full length, by the shortest way."""
        first, room, message = len(self._frames), self._room, self._message
        encrypt, update, append = self._encrypt, self._running.update, self._frames.append
        heads = Heads(self._header._replace(length=room + TAG_BYTES), first, end - first)
        begins = range(first * room, end * room, room)
        for begin, (header,), (additional,), (nonce,) in zip(begins, *heads.each(), strict=True):
            sealed = encrypt(nonce, message[begin : begin + room], additional)
            update(sealed)
            append(header + sealed)

    def _seal_one(self, part: int) -> None:
        header, room = self._header, self._room
        plain = self._message[part * room : (part + 1) * room]
        is_last = part == header.parts - 1
        length = len(plain) + TAG_BYTES + (SIGNATURE_BYTES if is_last else 0)
        kind, flags, hops_left, epoch, _, number, _, parts, incarnation, to, source = header
        flags |= _LAST * is_last
        head = encode(Header(kind, flags, hops_left, epoch, length, number, part, parts, incarnation, to, source))
        sealed = self._encrypt(_NONCE.pack(header.number, part), plain, authenticated(head))
        self._running.update(sealed)
        frame = head + sealed
        if is_last:
            frame += self._signer.sign_digest(self._running.digest())
            self._message = self._message[:0]  # the frames hold all of it now
        self._frames.append(frame)


class Opener:
    """Opens the parts of one kind of message of one source's incarnation, under one epoch's key."""

    def __init__(self, secret: bytes, kind: int, source: bytes, incarnation: int, destination: bytes) -> None:
        self._decrypt = AESGCM(seal_key(secret, kind, source, incarnation, destination)).decrypt

    def open_run(
        self, heads: Heads, first: int, length: int, arrivals: Sequence[Arrival], at: int
    ) -> tuple[list[bytes], list[bytes]]:
        """Open the parts from ``first`` on, as far as ``arrivals[at:]`` brings them in order; the shortest way.

        A frame that is not, to the bit, the one that ``heads`` foretell ends the run, as does one that was altered:
        ``open`` must look at it.

        Args:
            length: payload bytes of each part; ``heads`` are of parts that are not the last.

        Returns:
            plaintexts and payloads.
        """
        plains: list[bytes] = []
        payloads: list[bytes] = []
        decrypt, end = self._decrypt, HEADER_BYTES + length
        expected = islice(zip(*heads.each(), strict=True), first - heads.first, None)
        for ((header,), (additional,), (nonce,)), arrival in zip(expected, islice(arrivals, at, None), strict=False):
            frame = arrival.frame
            if not frame.startswith(header):
                break
            sealed = frame[HEADER_BYTES:end]
            try:
                plains.append(decrypt(nonce, sealed, additional))
            except InvalidTag:
                break
            payloads.append(sealed)
        return plains, payloads

    def open(self, header: Header, frame: bytes) -> tuple[bytes, bytes, bytes]:
        """Return plaintext, payload as the signature covers it, and signature (empty but for the last part).

        Args:
            header: of this frame, already decoded.
            frame: from the header on; Ethernet padding may follow the payload.

        Raises:
            EnvelopeError: too short, flagged wrongly, or altered; the part is worth nothing.
        """
        end = HEADER_BYTES + header.length
        is_last = header.part == header.parts - 1
        if is_last != bool(header.flags & _LAST):
            raise EnvelopeError(DropReason.BAD_PARTS, "the last part is flagged as such, and no other")
        sealed_end = end - SIGNATURE_BYTES if is_last else end
        if sealed_end - HEADER_BYTES < TAG_BYTES:
            raise EnvelopeError(DropReason.TRUNCATED, "shorter than a tag")
        sealed = frame[HEADER_BYTES:sealed_end]
        try:
            plain = self._decrypt(_NONCE.pack(header.number, header.part), sealed, authenticated(frame))
        except InvalidTag:
            raise EnvelopeError(DropReason.BAD_TAG) from None
        return plain, sealed, frame[sealed_end:end]
