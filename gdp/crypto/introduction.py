"""Introduction of a reader's incarnation: its X25519 key, signed with the key that is part of its name.

Sans-I/O. A name is the hash of its metadata's digest and of its key, so nothing else is needed to prove the signer.
Wire form, big-endian: ``started (8) | X25519 key (32) | digest of the name's metadata (32) | key, compressed (33) |
signature (64)``. The signature is ECDSA over ``"gdp-introduction-1" | name (32) | incarnation (8) | started (8) |
X25519 key (32)``.

The X25519 key is drawn for one incarnation of a process; the node's ECDSA key signs and does nothing else.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, StatementError
from gdp.names import Name

_LAYOUT: Final = struct.Struct("!Q32s32s33s64s")
_SIGNED: Final = struct.Struct("!18s32sQQ32s")
INTRODUCTION_BYTES: Final = _LAYOUT.size


@dataclass(frozen=True, slots=True)
class Introduction:
    """A verified introduction.

    Args:
        name: of the reader.
        incarnation: of its present run.
        started: rises with each incarnation; wall-clock milliseconds of the start, or above those of earlier
            incarnations.
        exchange: its X25519 public key, 32 bytes.
    """

    name: Name
    incarnation: int
    started: int
    exchange: bytes

    @classmethod
    def make(cls, subject: Subject, key: SigningKey, incarnation: int, started: int, exchange: bytes) -> bytes:
        """Return a node's introduction of an incarnation; costs a signature, about 25 us."""
        signature = key.sign(_signed(subject.name, incarnation, started, exchange))
        return _LAYOUT.pack(started, exchange, subject.digest, subject.owner_key, signature)

    @classmethod
    def from_wire(cls, wire: bytes, name: Name, incarnation: int) -> Introduction:
        """Read the introduction of an incarnation of the node with this name; costs about 70 us.

        Raises:
            StatementError: MALFORMED, WRONG_NAME or BAD_SIGNATURE.
        """
        if len(wire) != INTRODUCTION_BYTES:
            raise StatementError(DropReason.MALFORMED, "an introduction of another length")
        started, exchange, digest, key, signature = _LAYOUT.unpack(wire)
        subject = Subject.proving(name, digest, key)
        PublicKey.from_compressed(subject.owner_key).verify(signature, _signed(name, incarnation, started, exchange))
        return cls(name, incarnation, started, exchange)


def _signed(name: Name, incarnation: int, started: int, exchange: bytes) -> bytes:
    return _SIGNED.pack(b"gdp-introduction-1", name, incarnation, started, exchange)
