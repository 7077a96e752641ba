"""Parity of a message's frames: which frames form a block, what of them is coded, and what a parity frame carries.

Sans-I/O. ``gdp/message/erasure.py`` is the code, ``gdp/frame/spec.md`` gives each byte.

The frames of a message form spans of up to ``SPAN_PARTS`` consecutive ones. The blocks of a span are interleaved: a
burst of losses then takes few frames of each. A shard is ``payload length (2) || payload``, with zeros up to the
longest one of its block. The payload is sealed, so the code knows nothing of seals. The header of a lost frame follows
from the header of any other frame of its message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import HEADER_BYTES, Flag, Header, encode
from gdp.message.erasure import DATA_MAX, PARITY_MAX

SPAN_PARTS: Final = 1_024  # what a reader keeps for a message of any size: 1.5 MB of frames of 1,500 bytes
_LENGTH: Final = struct.Struct("!H")
_FIELDS: Final = struct.Struct("!IBB")
_LENGTH_AT: Final = 6  # in the header
SHARD_OVERHEAD_BYTES: Final = _LENGTH.size
# what a parity body has beyond the payload that it may restore
OVERHEAD_BYTES: Final = _FIELDS.size + SHARD_OVERHEAD_BYTES
_LAST: Final = int(Flag.LAST)


class Block(NamedTuple):
    """Block of frames: ``size`` parts from ``first`` on, each ``stride`` after the one before."""

    first: int
    stride: int
    size: int

    @property
    def parts(self) -> range:
        """Return the parts, in order."""
        return range(self.first, self.first + self.size * self.stride, self.stride)


@dataclass(frozen=True, slots=True)
class Parity:
    """Body of a parity frame: parity shard ``index`` of the ``count`` of one block."""

    first: int  # part with which the block begins
    index: int
    count: int
    shard: bytes

    def to_wire(self) -> bytes:
        """Return the body."""
        return _FIELDS.pack(self.first, self.index, self.count) + self.shard

    @classmethod
    def from_wire(cls, body: bytes) -> Parity:
        """Return the parity of a body. Raises ``EnvelopeError``: MALFORMED, too short, or an index out of bounds."""
        if len(body) <= OVERHEAD_BYTES:
            raise EnvelopeError(DropReason.MALFORMED, "parity without a shard")
        first, index, count = _FIELDS.unpack_from(body)
        if not index < count <= PARITY_MAX:
            raise EnvelopeError(DropReason.MALFORMED, f"parity {index} of {count}")
        return cls(first, index, count, body[_FIELDS.size :])


def span_of(part: int, parts: int) -> range:
    """Return the parts of the span in which a part is."""
    first = part - part % SPAN_PARTS
    return range(first, min(first + SPAN_PARTS, parts))


def blocks_of(span: range) -> list[Block]:
    """Return the blocks of a span."""
    stride = -(-len(span) // DATA_MAX)
    return [Block(span[at], stride, -(-(len(span) - at) // stride)) for at in range(stride)]


def shard_of(frame: bytes, size: int) -> bytes:
    """Return the shard of a frame (from the header on), ``size`` bytes long.

    Raises:
        EnvelopeError: MALFORMED, the payload is longer.
    """
    (length,) = _LENGTH.unpack_from(frame, _LENGTH_AT)
    if length + _LENGTH.size > size:
        raise EnvelopeError(DropReason.MALFORMED, "a frame longer than the parity of its block")
    return (_LENGTH.pack(length) + frame[HEADER_BYTES : HEADER_BYTES + length]).ljust(size, b"\0")


def frame_of(header: Header, part: int, shard: bytes) -> bytes:
    """Return the frame of a shard, by the header of another frame of its message.

    Raises:
        EnvelopeError: MALFORMED, a length beyond the shard.
    """
    (length,) = _LENGTH.unpack_from(shard)
    if length + _LENGTH.size > len(shard):
        raise EnvelopeError(DropReason.MALFORMED, "a length beyond its shard")
    flags = header.flags & ~_LAST | (_LAST if part == header.parts - 1 else 0)
    return encode(header._replace(flags=flags, part=part, length=length)) + shard[_LENGTH.size : _LENGTH.size + length]
