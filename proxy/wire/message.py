"""Envelope of a ROS message inside a sealed message, and the description of a publisher's messages.

Sans-I/O. Wire form of a message, big-endian: ``version (1) | channel (2) | stamp in ns (8) | body``. A description is a
map in deterministic CBOR: ``e`` the encoding of all bodies, ``c`` the channels to which the messages' numbers refer.
Invalid bytes raise ``RemoteError`` (MALFORMED).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.crypto.cbor import decode, encode
from gdp.errors import DropReason, LocalError, RemoteError
from proxy.serial.channel import Channel
from proxy.serial.schema import DEFINITION_MAX_BYTES, definition_bytes
from proxy.serial.serializer import Encoding

__all__ = ["RosMessage", "TopicDescription"]

VERSION: Final = 1
CHANNELS_MAX: Final = 256
DESCRIPTION_MAX_BYTES: Final = 4 << 20  # many channels of one topic may contain the same definition
_HEAD: Final = struct.Struct("!BHQ")
_ENCODINGS: Final[dict[object, Encoding]] = {"json": "json", "cbor": "cbor", "cdr": "cdr"}


class RosMessage(NamedTuple):
    """One ROS message.

    ``channel`` is an index into the description's channels; ``stamp_ns`` is the wall clock of the sending proxy when it
    received the message.
    """

    channel: int
    stamp_ns: int
    body: bytes

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _HEAD.pack(VERSION, self.channel, self.stamp_ns) + self.body

    @classmethod
    def from_wire(cls, wire: bytes) -> RosMessage:
        """Read the wire form."""
        if len(wire) < _HEAD.size:
            raise RemoteError(DropReason.MALFORMED, "parcel")
        version, channel, stamp_ns = _HEAD.unpack_from(wire)
        if version != VERSION:
            raise RemoteError(DropReason.BAD_VERSION, f"parcel version {version}")
        return cls(channel, stamp_ns, wire[_HEAD.size :])


@dataclass(frozen=True, slots=True)
class TopicDescription:
    """Description of the messages of one publisher of one topic."""

    encoding: Encoding
    channels: tuple[Channel, ...]

    def to_wire(self) -> bytes:
        """Return the wire form.

        Raises:
            LocalError: too many channels, or too long descriptions.
        """
        if len(self.channels) > CHANNELS_MAX:
            raise LocalError(f"{len(self.channels)} connections of one topic; at most {CHANNELS_MAX} are allowed")
        if self.definitions_bytes > DEFINITION_MAX_BYTES:
            detail = f"definitions of {self.definitions_bytes} bytes; at most {DEFINITION_MAX_BYTES} are allowed"
            raise LocalError(detail)
        wire = encode({"e": self.encoding, "c": [channel.to_wire() for channel in self.channels]})
        if len(wire) > DESCRIPTION_MAX_BYTES:
            raise LocalError(f"a description of {len(wire)} bytes; at most {DESCRIPTION_MAX_BYTES} are allowed")
        return wire

    @property
    def definitions_bytes(self) -> int:
        """Return the length of all different definitions together."""
        return sum(map(definition_bytes, {channel.definition for channel in self.channels}))

    @classmethod
    def from_wire(cls, wire: bytes) -> TopicDescription:
        """Read the wire form."""
        match decode(wire, DESCRIPTION_MAX_BYTES):
            case {"e": str(encoding), "c": [*channels]} if encoding in _ENCODINGS and 0 < len(channels) <= CHANNELS_MAX:
                wires = [each for each in channels if isinstance(each, bytes)]
                if len(wires) == len(channels):
                    description = cls(_ENCODINGS[encoding], tuple(map(Channel.from_wire, wires)))
                    if description.definitions_bytes <= DEFINITION_MAX_BYTES:
                        return description
        raise RemoteError(DropReason.MALFORMED, "description")
