"""Message envelope: it seals a message into frames, and opens its fragments one by one.

Sans-I/O; no clock, no memory of messages (that is ``gdp/message``). Source: docs/explanation/design.md, section 4;
XAES-256-GCM (C2SP), NIST SP 800-38D (GCM), RFC 5869 (HKDF), FIPS 186-5 (ECDSA). ``frame/spec.md`` gives each byte. The
header fields call a fragment a part.

::

    part 0                 part 1                       last part
    header|salt|c0|tag     header|salt|c1|tag    ...    header|salt|cn|tag|signature

Each part is XAES-256-GCM under a key that belongs to (topic secret, kind, source, incarnation, destination). Its nonce
of 24 bytes is salt || 0 (4) || message number || part. The additional data are the header without its hops-left field.
The salt is drawn for each message, because copies of a process, such as two machines resumed from one snapshot, use the
same numbers. The signature covers SHA-256 over the header fields that all parts share, the salt, each ciphertext and
tag. A stream under a session secret (``session_seal.py``) has no signature: only its two ends can make its seals.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol, overload

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers import Cipher, modes
from cryptography.hazmat.primitives.ciphers.algorithms import AES256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp import burst
from gdp.burst.cipher import BODY_AT, SALT_BYTES, TAG_BYTES, MessageCipher
from gdp.errors import DropReason, EnvelopeError, LocalError
from gdp.frame.codec import (
    FLAGS_AT,
    HEADER_BYTES,
    HOPS_AT,
    INCARNATION_AT,
    LENGTH_AT,
    NUMBER_AT,
    PACE_AT,
    PART_AT,
    Flag,
    Header,
    encode,
)
from gdp.limits import FRAME_MAX_BYTES, HOPS_MAX, MESSAGE_MAX_BYTES, PARTS_MAX, SEQUENCE_BYTES

SEAL_BYTES: Final = SALT_BYTES + TAG_BYTES  # bytes of a sealed part without its ciphertext
SIGNATURE_BYTES: Final = 64
SECRET_BYTES: Final = 32
_LAST: Final = int(Flag.LAST)  # a plain integer: an IntFlag's operators cost a microsecond each
SHARED_FLAGS: Final = 0xFF & ~_LAST  # of all parts of a message
_NUMBERS: Final = struct.Struct("!QII")  # of message, part and parts
_KEYS_KEPT: Final = 64  # messages of one source whose parts may interleave without another derivation


class Signer(Protocol):
    """Signing key of a writer, as the envelope needs it."""

    def sign_digest(self, digest: bytes) -> bytes:
        """Return 64 bytes, r || s, over a SHA-256 digest."""


class KeyContext(NamedTuple):
    """What a key is bound to: one kind of message of one source's incarnation towards one destination."""

    kind: int
    source: bytes
    incarnation: int
    destination: bytes


def seal_key(secret: bytes, kind: int, source: bytes, incarnation: int, destination: bytes) -> bytes:
    """Return the 32-byte key of one source's incarnation towards one destination.

    A restarted source has a new incarnation, hence a new key. So no nonce recurs under one key, even after a crash.

    Args:
        secret: topic secret of the epoch, 32 bytes.
    """
    if len(secret) != SECRET_BYTES:
        raise LocalError(f"a topic secret has {SECRET_BYTES} bytes, not {len(secret)}")
    info = b"gdp-seal-2" + bytes([kind]) + source + incarnation.to_bytes(8, "big") + destination
    return HKDF(algorithm=hashes.SHA256(), length=32, salt=None, info=info).derive(secret)


class MessageKeys:
    """The keys of messages, derived from one key of 32 bytes by a message's salt.

    Source: XAES-256-GCM (C2SP, 2024), whose derivation is the CMAC-based KDF in counter mode of NIST SP 800-108r1. A
    derivation costs about 2 us.
    """

    def __init__(self, key: bytes) -> None:
        self._encrypt = Cipher(AES256(key), modes.ECB()).encryptor().update  # single blocks, as CMAC has them
        zero = int.from_bytes(self._encrypt(bytes(16)), "big")
        subkey = (zero << 1 & (1 << 128) - 1) ^ (0x87 if zero >> 127 else 0)
        counters = int.from_bytes(b"\x00\x01X\x00" + bytes(12) + b"\x00\x02X\x00" + bytes(12), "big")
        self._mask = counters ^ (subkey << 128 | subkey)

    def of(self, salt: bytes) -> bytes:
        """Return the key of a salt of up to 12 bytes: the first half of XAES's nonce, padded with zeros."""
        first = int.from_bytes((salt + bytes(12))[:12], "big")
        return self._encrypt(((first << 128 | first) ^ self._mask).to_bytes(32, "big"))


def salt_of(frame: bytes) -> bytes:
    """Return the salt of a sealed part; not yet authenticated, and shorter where the part is."""
    return frame[HEADER_BYTES:BODY_AT]


def fragment_capacity(mtu: int) -> int:
    """Return the plaintext bytes that one part carries where links take ``mtu`` bytes after the Ethernet header."""
    capacity = min(mtu, FRAME_MAX_BYTES) - HEADER_BYTES - SEAL_BYTES
    if capacity <= SIGNATURE_BYTES:
        raise LocalError(f"an MTU of {mtu} bytes carries no sealed part")
    return capacity


def digest_of(frame: bytes) -> hashlib._Hash:
    """Return the running SHA-256 of a message, fed with what all its parts share: header fields and salt."""
    flags = bytes([frame[FLAGS_AT] & SHARED_FLAGS])
    before, number = frame[:FLAGS_AT] + flags + frame[HOPS_AT + 1 : LENGTH_AT], frame[NUMBER_AT:PART_AT]
    return burst.DIGEST(b"gdp-message-2" + before + number + frame[PACE_AT:BODY_AT])


class Sealer:
    """Seals the messages of one context, under one epoch's key.

    Args:
        random_bytes: the system's randomness, drawn for each message and never ahead: values drawn before a machine was
            copied are no longer random.
        signer: None: the messages are not signed, which is for a session secret alone.
        address: the destination in the headers; None: that of the context.
    """

    def __init__(
        self,
        *,
        secret: bytes,
        epoch: int,
        context: KeyContext,
        signer: Signer | None,
        random_bytes: Callable[[int], bytes],
        address: bytes | None = None,
    ) -> None:
        self._keys = MessageKeys(seal_key(secret, *context))
        self._signer = signer
        self._signature_bytes = 0 if signer is None else SIGNATURE_BYTES
        self._random_bytes = random_bytes
        kind, source, incarnation, destination = context
        self._fixed = (epoch, kind, incarnation, destination if address is None else address, source)
        self._last_number = -1
        self._template = (-1, b"")  # flags of the message before, and the header of its first part
        self._capacity = (-1, 0)  # its MTU, and the plaintext bytes of a part

    def seal(self, number: int, flags: int, message: bytes | Sealed, mtu: int, prefix: bytes = b"") -> Sealed:
        """Return a message as its frames, each from the header on and at most ``mtu`` bytes long.

        A part is encrypted when its frame is first requested. So the first frames may leave before the last ones are
        sealed.

        Args:
            number: message number; above every earlier number of this sealer.
            flags: without ``Flag.LAST``.
            message: a ``Sealed`` message is opened when the first frame is requested.
            prefix: goes before it under the seal, so that a large message need not be copied; shorter than a frame.

        Raises:
            LocalError: a number that is not newer (its nonces would recur), or a message above the limits.
        """
        if number <= self._last_number:
            raise LocalError(f"message number {number} was sealed before")
        origin: Sealed | None = None
        # Checks for bytes first: an ``isinstance`` check for ``Sealed``, an abstract class's, costs a microsecond.
        if isinstance(message, bytes):
            size = len(prefix) + len(message)
        else:
            size, origin, message = len(prefix) + message.message_bytes, message._origin or message, b""
        if self._capacity[0] != mtu:
            self._capacity = mtu, fragment_capacity(mtu)
        capacity = self._capacity[1]
        parts = -(-(size + self._signature_bytes) // capacity) or 1
        if size > MESSAGE_MAX_BYTES + SEQUENCE_BYTES or parts > PARTS_MAX:
            raise LocalError(f"a message of {size} bytes in {parts} parts is above the limit")
        self._last_number = number
        if self._template[0] != flags:
            epoch, kind, incarnation, destination, source = self._fixed
            header = Header(kind, flags, HOPS_MAX, epoch, 0, 0, 0, 1, incarnation, destination, source)
            self._template = flags, encode(header)
        template = self._template[1]
        salt = self._random_bytes(SALT_BYTES)
        head = template[:NUMBER_AT] + _NUMBERS.pack(number, 0, parts) + template[INCARNATION_AT:] + salt
        cipher, signer = burst.CIPHER(self._keys.of(salt)), self._signer
        sealed = Sealed(
            cipher=cipher, signer=signer, head=head, parts=parts, prefix=prefix, message=message, size=size,
            capacity=capacity,
        )  # fmt: skip
        sealed._origin = origin
        return sealed


class Sealed(Sequence[bytes]):
    """The frames of one message, ``parts`` of them, sealed in order and on request; always the same bytes."""

    def __init__(
        self,
        *,
        cipher: MessageCipher,
        signer: Signer | None,
        head: bytes,
        parts: int,
        prefix: bytes,
        message: bytes,
        size: int,
        capacity: int,
    ) -> None:
        self._cipher = cipher
        self._signer = signer
        self._signature_bytes = 0 if signer is None else SIGNATURE_BYTES
        self._head, self.parts, self._prefix = head, parts, prefix
        self._message = message
        self._origin: Sealed | None = None  # opened when the first frame is requested
        self._capacity = capacity
        self._running = None if signer is None else digest_of(head)
        self._frames: list[bytes] = []
        self.message_bytes = size
        self.size_bytes = size + parts * (HEADER_BYTES + SEAL_BYTES) + self._signature_bytes

    def __len__(self) -> int:
        return self.parts

    @overload
    def __getitem__(self, at: int) -> bytes: ...

    @overload
    def __getitem__(self, at: slice) -> list[bytes]: ...

    def __getitem__(self, at: int | slice) -> bytes | list[bytes]:
        parts = self.parts
        if not isinstance(at, slice):
            end = at % parts + 1 if -parts <= at < parts else parts
        elif at.stop is None or at.stop < 0:
            end = at.indices(parts)[1]
        else:
            end = at.stop if at.stop < parts else parts
        begin = len(self._frames)
        if begin < end:
            self._seal(begin, end)
        return self._frames[at]

    def set_pace(self, pace: int) -> None:
        """Set the pace in the headers, if no frame is sealed yet."""
        if self._frames:
            return
        self._head = self._head[:PACE_AT] + bytes([pace]) + self._head[PACE_AT + 1 :]
        self._running = None if self._signer is None else digest_of(self._head)

    @property
    def largest(self) -> int:
        """Return the bytes of the largest frame, sealed or not."""
        return self.size_bytes if self.parts == 1 else self._capacity + HEADER_BYTES + SEAL_BYTES

    def message(self) -> bytes:
        """Return the plaintext, to be sealed again under another number."""
        if self._origin is not None:
            return self._origin.message()
        frames = self._frames
        if len(frames) < self.parts:
            return self._prefix + self._message
        ends = [len(frame) for frame in frames]
        ends[-1] -= self._signature_bytes
        opened = [self._cipher.open(frame, end) for frame, end in zip(frames, ends, strict=True)]
        return b"".join([each[0] for each in opened if each is not None])

    def _seal(self, begin: int, end: int) -> None:
        if self._origin is not None:
            self._message, self._origin = self._origin.message(), None
        frames, signs = self._frames, (self._signature_bytes, self._running)
        frames += self._cipher.seal(self._head, begin, end, self._prefix, self._message, self._capacity, *signs)
        if self._signer is not None and self._running is not None and end == self.parts:
            frames[-1] += self._signer.sign_digest(self._running.digest())
        if end == self.parts:
            self._message = b""  # the frames hold all of it now


# Plaintext; ciphertext and tag, as the signature covers them; signature of a signed last part.
Opened = tuple[bytes, bytes, bytes]


class Opener:
    """Opens the parts of one kind of message of one source's incarnation, under one epoch's key.

    Args:
        is_signed: the last part carries a signature; False for a session secret alone.
    """

    def __init__(
        self,
        secret: bytes,
        kind: int,
        source: bytes,
        incarnation: int,
        destination: bytes,
        *,
        is_signed: bool = True,
    ) -> None:
        self._signature_bytes = SIGNATURE_BYTES if is_signed else 0
        self._keys = MessageKeys(seal_key(secret, kind, source, incarnation, destination))
        self._known: dict[bytes, MessageCipher] = {}  # by the salts of messages with opened parts

    def cipher_of(self, salt: bytes) -> MessageCipher:
        """Return the cipher of the message with a salt."""
        return self._known.get(salt) or burst.CIPHER(self._keys.of(salt))

    def open(self, header: Header, frame: bytes) -> Opened:
        """Open a part.

        Args:
            header: of this frame, already decoded.
            frame: from the header on; Ethernet padding may follow the payload.

        Raises:
            EnvelopeError: too short, flagged wrongly, or altered; the part must be dropped.
        """
        end = HEADER_BYTES + header.length
        is_last = header.part == header.parts - 1
        if is_last != bool(header.flags & _LAST):
            raise EnvelopeError(DropReason.BAD_PARTS, "the last part is flagged as such, and no other")
        sealed_end = end - self._signature_bytes if is_last else end
        if sealed_end - HEADER_BYTES < SEAL_BYTES:
            raise EnvelopeError(DropReason.TRUNCATED, "shorter than a salt and a tag")
        salt = frame[HEADER_BYTES:BODY_AT]
        cipher = self.cipher_of(salt) if header.parts > 1 else burst.CIPHER(self._keys.of(salt))
        opened = cipher.open(frame, sealed_end)
        if opened is None:
            raise EnvelopeError(DropReason.BAD_TAG)
        if header.parts > 1 and salt not in self._known:
            if len(self._known) >= _KEYS_KEPT:
                del self._known[next(iter(self._known))]
            self._known[salt] = cipher
        return *opened, frame[sealed_end:end]
