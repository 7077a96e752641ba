"""Frame header codec as a struct: the fast twin of the Scapy layer.

Sans-I/O; the only codec that a data path imports. ``gdp/frame/layers.py`` is the normative definition; generated tests
compare the two. Offsets count from the first byte after the EtherType (see ``spec.md``)::

    0 version  1 kind  2 flags  3 hops left, second path  4 key epoch (2)  6 payload length (2)  8 message number (8)
    16 part (4)  20 pace  21 parts (3)  24 incarnation (8)  32 destination (32)  64 source (32)  96 payload
"""

from __future__ import annotations

import re
import struct
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError
from gdp.frame.kinds import ETHERTYPE, VERSION
from gdp.limits import PARTS_MAX
from gdp.names import NAME_BYTES
from gdp.sansio import new_tuple

ETHER_BYTES: Final = 14
HEADER_BYTES: Final = 96
OVERHEAD_BYTES: Final = ETHER_BYTES + HEADER_BYTES
KIND_AT: Final = 1
FLAGS_AT: Final = 2
HOPS_AT: Final = 3
LENGTH_AT: Final = 6
NUMBER_AT: Final = 8
PART_AT: Final = 16
PACE_AT: Final = 20
PARTS_AT: Final = 21
PARTS_MASK: Final = (1 << 24) - 1  # of the four bytes from ``PACE_AT`` on
INCARNATION_AT: Final = 24
DESTINATION_AT: Final = 32
SOURCE_AT: Final = 64
HOPS_MASK: Final = 0x7F  # of the byte at ``HOPS_AT``: how many hops are left
SECOND_PATH: Final = 0x80  # of the same byte: the copy for the second path

NUMBER_AND_PART: Final = struct.Struct("!QI")  # at ``NUMBER_AT``
_HEADER: Final = struct.Struct("!BBBBHHQIIQ32s32s")  # pace and parts as one number
_LAYOUT: Final = "BBBBHHQIB3sQ32s32s"
_PACE_SHIFT: Final = 24
_BEHIND_VERSION: Final = struct.Struct("!xBBBHHQIIQ32s32s")
_ETHERTYPE: Final = ETHERTYPE.to_bytes(2, "big")
assert _HEADER.size == HEADER_BYTES


class Header(NamedTuple):
    """Header of one frame; a tuple because it is on the hot path. Field meanings: ``spec.md``."""

    kind: int
    flags: int
    hops_left: int  # the whole byte: hops in ``HOPS_MASK``, and ``SECOND_PATH``
    epoch: int
    length: int  # payload bytes
    number: int
    part: int
    parts: int
    incarnation: int
    destination: bytes
    source: bytes
    pace: int = 0  # of the slowest branch that gets a copy


def layout() -> dict[str, tuple[int, int]]:
    """Return offset and size in bytes of every header field; a test compares them with the Scapy layer."""
    *fields, pace = Header._fields
    fields.insert(fields.index("parts"), pace)
    sizes = [struct.calcsize(f"!{each}") for each in re.findall("[0-9]*[A-Zs]", _LAYOUT)]
    return {
        name: (sum(sizes[:index]), size)
        for index, (name, size) in enumerate(zip(("version", *fields), sizes, strict=True))
    }


def encode(header: Header) -> bytes:
    """Return the 96 bytes of a header (version 1)."""
    *before, parts, incarnation, destination, source, pace = header
    return _HEADER.pack(VERSION, *before, pace << _PACE_SHIFT | parts, incarnation, destination, source)


def decode(frame: bytes | bytearray | memoryview, at: int = 0) -> Header:
    """Read the header at ``frame[at:]`` (the byte after the EtherType); bytes behind the payload are Ethernet padding.

    Raises:
        FrameError: truncated, another version, or an impossible part; never anything else, whatever the bytes.
    """
    size = len(frame) - at
    if size < HEADER_BYTES:
        raise FrameError(DropReason.TRUNCATED, "header")
    if frame[at] != VERSION:
        raise FrameError(DropReason.BAD_VERSION, str(frame[at]))
    fields = _BEHIND_VERSION.unpack_from(frame, at)
    _, _, _, _, length, _, part, parts, _, _, _ = fields
    pace = 0
    if parts > PARTS_MASK:
        pace, parts = parts >> _PACE_SHIFT, parts & PARTS_MASK
        fields = *fields[:7], parts, *fields[8:]
    if size - HEADER_BYTES < length:
        raise FrameError(DropReason.TRUNCATED, "payload")
    if not part < parts <= PARTS_MAX:
        raise FrameError(DropReason.BAD_PARTS, f"{part} of {parts}")
    return new_tuple(Header, (*fields, pace))


def authenticated(header: bytes) -> bytes:
    """Return the 95 bytes that a seal covers: a header (or a frame from it on) without hops left."""
    return header[:HOPS_AT] + header[HOPS_AT + 1 : HEADER_BYTES]


def second_path_key(destination: bytes) -> bytes:
    """Return the key of a forwarding table for the second path: 32 bytes, the destination with its last bit inverted.

    What follows the destination in a key (the source) stays as it is.
    """
    last = NAME_BYTES - 1
    return destination[:last] + bytes([destination[last] ^ 1]) + destination[NAME_BYTES:]


def second_path_copy(frame: bytes) -> bytes:
    """Return the copy of a frame (from the header on) for the second path: the same bytes but for one bit."""
    return frame[:HOPS_AT] + bytes([frame[HOPS_AT] | SECOND_PATH]) + frame[HOPS_AT + 1 :]


def ethernet(destination_mac: bytes, source_mac: bytes) -> bytes:
    """Return the 14-byte Ethernet II header (two 6-byte addresses and our EtherType)."""
    return destination_mac + source_mac + _ETHERTYPE
