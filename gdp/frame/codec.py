"""Frame header: the registry of kinds and flags, and the codec as a struct, the fast twin of the Scapy layer.

Sans-I/O; the only codec that a data path imports. ``gdp/frame/layers.py`` is the normative definition; generated tests
compare the two. Offsets count from the first byte after the EtherType (see ``spec.md``)::

    0 version  1 kind  2 flags  3 hops left, second path  4 key epoch (2)  6 payload length (2)  8 message number (8)
    16 part (4)  20 pace  21 parts (3)  24 incarnation (8)  32 destination (32)  64 source (32)  96 payload

A frame of a kind below 0x80 goes end to end, and the table forwards it. From 0x80 on it is for the neighbour itself,
and every data plane punts it.
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError
from gdp.limits import PARTS_MAX
from gdp.names import NAME_BYTES
from gdp.sansio import new_tuple

ETHERTYPE: Final = 0x88B5  # IEEE 802 local experimental EtherType 1; IEEE 802-2014, clause 9.2.4
VERSION: Final = 1
CONTROL_FROM: Final = 0x80
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


class Kind(IntEnum):
    """Kind of a frame's content. Unknown kinds below 0x80 are forwarded; at the end they are dropped and counted."""

    DATA = 0x01  # a sealed message fragment, publisher to readers
    HEARTBEAT = 0x02  # sealed: what a publisher still holds, and the topic's description
    ACKNACK = 0x03  # sealed: what a reader has and lacks, to the publisher
    INTRODUCTION = 0x04  # sealed: identity of a reader and its key for reports, to the publisher
    PARITY = 0x05  # sealed: a coded form of some frames of one message, which restores lost ones, publisher to readers
    RIB_REQUEST = 0x10  # a statement to a RIB
    RIB_ANSWER = 0x11  # a statement from a RIB
    RELOCATE = 0x12  # a statement of a node's new switch to its former one
    ECHO_REQUEST = 0x20
    ECHO_REPLY = 0x21
    DIAGNOSTIC_REQUEST = 0x22  # a statement to a member, or to the switch where its hops end
    DIAGNOSTIC_REPLY = 0x23  # a statement from there to the member that asked
    HELLO = 0x80  # to the neighbour: identity of the sender
    LINK_STATE = 0x81
    JOIN = 0x82  # to the neighbour: request for a tree
    LEAVE = 0x83
    ADVERTISE = 0x84  # an attached node's advertisement, to its switch
    WITHDRAW = 0x85
    ADVERTISE_ACK = 0x86  # the switch's acknowledgement to an attached node: accepted, or rejected with a reason
    REVOKE = 0x87  # to the neighbour, which forwards it: this certificate is revoked
    KEEPALIVE = 0x88  # to a neighbour that is up: sign of life; no statement, but a tag by a key of both sessions
    REDIRECT = 0x89  # to the neighbour whose frames came here: where the node is now
    WHERE = 0x8A  # to the neighbour whose frame came here, while no RIB answers: where is that node?
    # answer to a hello under load: the sender must prove this before its signature is verified; no statement
    COOKIE = 0x8B
    REVOKED = 0x8C  # between neighbours: which revocations each keeps, and those that the other lacks
    JOIN_REFRESH = 0x8D  # to the neighbour: which joins stand, and back: which of them are unknown
    PACE = 0x8E  # a reader to its switch: which messages of a publisher its branch gets


class Flag(IntFlag):
    """Flags of a frame, set once by the source; they are authenticated."""

    NONE = 0
    LAST = 0x01  # the last fragment, which carries the signature
    RELIABLE = 0x02  # readers request all that they miss, and wait for it
    BUNDLE = 0x04  # several messages under one seal
    ALL_REPLICAS = 0x08
    LATCHED = 0x10  # late joiners get it too
    URGENT = 0x20  # goes before frames without the flag, wherever frames queue
    PARITY = 0x40  # parity frames may follow the message's frames


class KeepaliveFlag(IntFlag):
    """Flags of a keepalive, its first byte after the header."""

    NONE = 0
    POLL = 1  # requests an answer at once
    FINAL = 2  # the answer to a poll
    HEARD = 4  # the sender receives the receiver's keepalives


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
