"""Record of a capsule: one sealed message as it was sent, a sealed description, a checkpoint, or a mark.

Sans-I/O. Wire form, big-endian::

    record  length of what follows (4) | type (1) | number (8) | time in ns since 1970 (8) | sequence number (8)
            | messages (4) | body | CRC-32 of all before (4)
    body    for each frame: length (2) | frame;  or a checkpoint (``checkpoint.py``)
            of a mark, its statement (``windows.py``) stands before the frames as one more

The numbers of records rise by one. A bundle has the sequence number of its first message. Where nothing was published,
``messages`` is 0. In a capsule of several topics the frames name theirs; a mark has its name once for each.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterator, Sequence
from enum import IntEnum
from itertools import pairwise
from typing import Final, NamedTuple

from gdp.errors import DropReason, RemoteError
from gdp.frame.codec import decode

RECORD_MAX_BYTES: Final = 48 << 20  # the largest message over the smallest link
_HEAD: Final = struct.Struct("!IBQQQI")
HEAD_BYTES: Final = _HEAD.size
_LENGTH: Final = struct.Struct("!I")
_CRC: Final = struct.Struct("!I")
_FRAME: Final = struct.Struct("!H")
RECORD_MIN_BYTES: Final = HEAD_BYTES + _CRC.size


class RecordType(IntEnum):
    """What the body of a record is."""

    MESSAGE = 1
    DESCRIPTION = 2  # a sealed Heartbeat that brings the publisher's description
    CHECKPOINT = 3
    MARK = 4  # an event, by its name and time


_TYPES: Final = {int(each): each for each in RecordType}


class Record(NamedTuple):
    """One record.

    Attributes:
        number: its place in the capsule, from 0.
        time_ns: when it was appended, by the writer's clock; it never falls.
        sequence: sequence number of its first message.
        messages: how many it carries.
    """

    type: RecordType
    number: int
    time_ns: int
    sequence: int
    messages: int
    body: bytes

    def to_wire(self) -> bytes:
        """Return the wire form."""
        length = RECORD_MIN_BYTES - _LENGTH.size + len(self.body)
        wire = _HEAD.pack(length, self.type, self.number, self.time_ns, self.sequence, self.messages) + self.body
        return wire + _CRC.pack(zlib.crc32(wire))

    @classmethod
    def from_wire(cls, wire: bytes) -> Record:
        """Read a whole record. Raises ``RemoteError``: MALFORMED."""
        if len(wire) < RECORD_MIN_BYTES or _LENGTH.unpack_from(wire)[0] != len(wire) - _LENGTH.size:
            raise RemoteError(DropReason.MALFORMED, "record of another length than it says")
        _, type_, number, time_ns, sequence, messages = _HEAD.unpack_from(wire)
        if type_ not in _TYPES or _CRC.unpack_from(wire, len(wire) - _CRC.size)[0] != zlib.crc32(wire[: -_CRC.size]):
            raise RemoteError(DropReason.MALFORMED, "record with a wrong checksum, or of an unknown type")
        return cls(_TYPES[type_], number, time_ns, sequence, messages, wire[HEAD_BYTES : -_CRC.size])

    @property
    def frames(self) -> list[bytes]:
        """Return the frames of a message or a description. Raises ``RemoteError``: MALFORMED."""
        frames, at, body = [], 0, self.body
        while at < len(body):
            begin = at + _FRAME.size
            at = begin + (_FRAME.unpack_from(body, at)[0] if begin <= len(body) else 0)
            if at > len(body) or at == begin:
                raise RemoteError(DropReason.MALFORMED, "record whose frames do not fill it")
            frames.append(body[begin:at])
        return frames

    @property
    def sealed(self) -> list[list[bytes]]:
        """Return the frames of each sealed message: one, but for a mark of several topics.

        Raises:
            RemoteError: MALFORMED.
        """
        frames = self.frames
        if self.type is not RecordType.MARK:
            return [frames]
        begins = [at for at, frame in enumerate(frames) if at and decode(frame).part == 0]
        return [frames[begin:end] for begin, end in pairwise([*begins, len(frames)])] if begins else [[]]


def body_of(frames: Sequence[bytes]) -> bytes:
    """Return the body with these frames."""
    return b"".join([each for frame in frames for each in (_FRAME.pack(len(frame)), frame)])


def leaf_of(wire: bytes) -> bytes:
    """Return the hash of a record: a leaf of the Merkle tree (RFC 9162, section 2.1.1)."""
    return hashlib.sha256(b"\0" + wire).digest()


def split(data: bytes, at: int = 0) -> Iterator[bytes]:
    """Yield the whole records in ``data[at:]``; a last part of one is left out.

    Raises:
        RemoteError: MALFORMED, a length that no record has.
    """
    while at + _LENGTH.size <= len(data):
        length = _LENGTH.unpack_from(data, at)[0]
        if not RECORD_MIN_BYTES - _LENGTH.size <= length <= RECORD_MAX_BYTES:
            raise RemoteError(DropReason.MALFORMED, f"record of {length} bytes")
        end = at + _LENGTH.size + length
        if end > len(data):
            return
        yield data[at:end]
        at = end


def size_of(data: bytes, at: int) -> int:
    """Return the bytes of the record that begins at ``at``."""
    return _LENGTH.size + int(_LENGTH.unpack_from(data, at)[0])


def number_of(data: bytes) -> int:
    """Return the number of the record that begins ``data``."""
    return int(_HEAD.unpack_from(data)[2])


def find(data: bytes, at: int) -> int | None:
    """Return where the next undamaged record begins, at ``at`` or later; None: there is none."""
    while at + RECORD_MIN_BYTES <= len(data):
        end = at + _LENGTH.size + _LENGTH.unpack_from(data, at)[0]
        if data[at + _LENGTH.size] in _TYPES and at + RECORD_MIN_BYTES <= end <= len(data):
            stated = _CRC.unpack_from(data, end - _CRC.size)[0]
            if stated == zlib.crc32(data[at : end - _CRC.size]):
                return at
        at += 1
    return None
