"""Node information ``ros_discovery_info``: a DDS participant's announcement of its nodes and their entities.

Sans-I/O. Up to Humble a GID has 24 bytes here, from Iron on 16.
Source: rmw_dds_common/msg/ParticipantEntitiesInfo.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

INFO_TOPIC: Final = "ros_discovery_info"
INFO_TYPE: Final = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
INFO_HASH: Final = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
GID_BYTES: Final = (16, 24)  # in Iron and later, and in Humble
_GID: Final = 16
_LITTLE: Final = b"\x00\x01\x00\x00"
_PAD_MAX: Final = 3


@dataclass(frozen=True, slots=True)
class NodeInfo:
    """Announcement of one participant: the node of each of its entities."""

    participant: bytes
    nodes: Mapping[bytes, str]
    gid_bytes: int


def write_info(participant: bytes, name: str, readers: Sequence[bytes], writers: Sequence[bytes], wide: int) -> bytes:
    """Return the message of a participant with one node in the root namespace."""
    out = _Writer()
    out.gid(participant, wide)
    out.count(1)
    out.text("/")
    out.text(name)
    for gids in (readers, writers):
        out.count(len(gids))
        for gid in gids:
            out.gid(gid, wide)
    return _LITTLE + bytes(out.body)


def read_info(raw: bytes) -> NodeInfo | None:
    """Return the content of a message; None if it is malformed."""
    for wide in GID_BYTES:
        try:
            info, end = _read(_Reader(raw[4:], "<" if raw[1:2] == b"\x01" else ">"), wide)
        except (struct.error, UnicodeDecodeError, ValueError):
            continue
        if 0 <= len(raw) - 4 - end <= _PAD_MAX:
            return info
    return None


def _read(reader: _Reader, wide: int) -> tuple[NodeInfo, int]:
    participant = reader.gid(wide)
    nodes: dict[bytes, str] = {}
    for _ in range(reader.count()):
        space, name = reader.text(), reader.text()
        full = f"{space.rstrip('/')}/{name}"
        for _ in ("readers", "writers"):
            for _ in range(reader.count()):
                nodes[reader.gid(wide)] = full
    return NodeInfo(participant, nodes, wide), reader.at


@dataclass(slots=True)
class _Writer:
    body: bytearray = field(default_factory=bytearray)

    def count(self, number: int) -> None:
        self.body += b"\0" * (-len(self.body) % 4) + struct.pack("<I", number)

    def text(self, text: str) -> None:
        encoded = text.encode() + b"\0"
        self.count(len(encoded))
        self.body += encoded

    def gid(self, gid: bytes, wide: int) -> None:
        self.body += gid.ljust(wide, b"\0")


@dataclass(slots=True)
class _Reader:
    body: bytes
    order: str
    at: int = 0

    def count(self) -> int:
        self.at += -self.at % 4
        (number,) = struct.unpack_from(f"{self.order}I", self.body, self.at)
        self.at += 4
        if number > len(self.body):
            raise ValueError("more than there can be")
        return int(number)

    def text(self) -> str:
        length = self.count()
        return self._bytes(length).rstrip(b"\0").decode()

    def gid(self, wide: int) -> bytes:
        return self._bytes(wide)[:_GID]

    def _bytes(self, length: int) -> bytes:
        found = self.body[self.at : self.at + length]
        if len(found) < length:
            raise ValueError("cut off")
        self.at += length
        return found
