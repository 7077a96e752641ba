"""Prepared frames of the benches: GDP frames, and IPv4 frames of the same length.

Sans-I/O. The source and the sink are names with entries at every switch.
"""

from __future__ import annotations

import ipaddress
import struct
from dataclasses import dataclass
from typing import Final

from gdp.frame.codec import DESTINATION_AT, ETHER_BYTES, HEADER_BYTES, OVERHEAD_BYTES, Header, encode
from gdp.frame.kinds import ETHERTYPE, Kind
from gdp.limits import HOPS_MAX

SOURCE, SINK = bytes([0xA0]) * 32, bytes([0xB0]) * 32
NAME_AT: Final = ETHER_BYTES + DESTINATION_AT
_IPV4: Final = 0x0800
_IP_HEADER: Final = struct.Struct("!BBHHHBBH4s4s")
_UDP_HEADER: Final = struct.Struct("!HHHH")
_DONT_FRAGMENT: Final = 0x4000
_TTL, _UDP, _PORT = 64, 17, 7


@dataclass(frozen=True, slots=True)
class Wire:
    """Frames of one baseline: its EtherType, a frame from source to sink, and one back."""

    ethertype: int
    out: bytes
    back: bytes


def gdp_frame(macs: bytes, size: int, destination: bytes, source: bytes) -> bytes:
    """Return a whole data frame of ``size`` bytes. Raises ``ValueError``: too small for the headers."""
    payload = size - OVERHEAD_BYTES
    if payload < 0:
        raise ValueError(f"a frame has at least {OVERHEAD_BYTES} bytes")
    header = Header(Kind.DATA, 0, HOPS_MAX, 1, payload, 0, 0, 1, 1, destination, source)
    frame = macs + ETHERTYPE.to_bytes(2, "big") + encode(header) + bytes(payload)
    assert len(frame) == ETHER_BYTES + HEADER_BYTES + payload
    return frame


def ip_frame(macs: bytes, size: int, destination: str, source: str) -> bytes:
    """Return a whole Ethernet, IPv4 and UDP frame of ``size`` bytes, with a correct header checksum."""
    length = size - ETHER_BYTES
    ends = (ipaddress.IPv4Address(source).packed, ipaddress.IPv4Address(destination).packed)
    header = _IP_HEADER.pack(0x45, 0, length, 0, _DONT_FRAGMENT, _TTL, _UDP, 0, *ends)
    header = _IP_HEADER.pack(0x45, 0, length, 0, _DONT_FRAGMENT, _TTL, _UDP, ip_checksum(header), *ends)
    data = length - _IP_HEADER.size
    udp = _UDP_HEADER.pack(_PORT, _PORT, data, 0) + bytes(data - _UDP_HEADER.size)
    return macs + _IPV4.to_bytes(2, "big") + header + udp


def ip_checksum(header: bytes) -> int:
    """Return the checksum of RFC 791 of an even number of bytes."""
    total: int = sum(struct.unpack(f"!{len(header) // 2}H", header))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF
