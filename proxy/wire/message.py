"""Envelope of a ROS message inside a sealed message, and the description of a publisher's messages.

Sans-I/O. Wire form of a message, big-endian: ``version (1) | steps (1) | channel (1) | stamp in ns (8) | body``. The
bits of ``steps`` say what was done to the body (``Step``). A description is a map in deterministic CBOR: ``e`` the
encoding of all bodies, ``c`` the channels to which the messages' numbers refer, ``z`` the codec of compressed bodies,
``d`` its dictionary, ``i`` the format of reduced images. The last three are there only where a rule states them.
Invalid bytes raise ``RemoteError``.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Final, NamedTuple

from gdp.crypto.cbor import Value, decode, encode
from gdp.errors import DropReason, LocalError, RemoteError
from proxy.reduce.compression import DICTIONARY_MAX_BYTES
from proxy.reduce.picture import PictureFormat
from proxy.serial.channel import Channel
from proxy.serial.schema import DEFINITION_MAX_BYTES, definition_bytes
from proxy.serial.serializer import Encoding

__all__ = ["RosMessage", "Step", "TopicDescription"]

VERSION: Final = 1
CHANNELS_MAX: Final = 256
DESCRIPTION_MAX_BYTES: Final = 4 << 20  # many channels of one topic may contain the same definition
_HEAD: Final = struct.Struct("!BBBQ")
_ENCODINGS: Final[dict[object, Encoding]] = {"json": "json", "cbor": "cbor", "cdr": "cdr"}

_IMAGES: Final[dict[object, PictureFormat]] = {"jpeg": "jpeg", "png": "png"}


class Step(IntFlag):
    """What was done to a body, and is undone by its reader from the highest bit down."""

    IMAGE = 1  # the field ``data`` of a sensor_msgs/Image is a file of the described format
    ZSTD = 2  # the body is one Zstandard frame


_STEPS: Final = int(Step.IMAGE | Step.ZSTD)


class RosMessage(NamedTuple):
    """One ROS message.

    ``channel`` is an index into the description's channels; ``stamp_ns`` is the wall clock of the sending proxy when it
    received the message; ``steps`` are those that its publisher has described.
    """

    channel: int
    stamp_ns: int
    body: bytes
    steps: Step = Step(0)

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _HEAD.pack(VERSION, self.steps, self.channel, self.stamp_ns) + self.body

    @classmethod
    def from_wire(cls, wire: bytes) -> RosMessage:
        """Read the wire form."""
        if len(wire) < _HEAD.size:
            raise RemoteError(DropReason.MALFORMED, "parcel")
        version, steps, channel, stamp_ns = _HEAD.unpack_from(wire)
        if version != VERSION:
            raise RemoteError(DropReason.BAD_VERSION, f"parcel version {version}")
        if steps & ~_STEPS:
            raise RemoteError(DropReason.BAD_VERSION, f"steps {steps:#x} that are unknown here")
        return cls(channel, stamp_ns, wire[_HEAD.size :], Step(steps))


@dataclass(frozen=True, slots=True)
class TopicDescription:
    """Description of the messages of one publisher of one topic.

    Attributes:
        is_compressed: whether bodies may be Zstandard frames.
        dictionary: of those frames, at most ``DICTIONARY_MAX_BYTES``; empty: none. It is here rather than in a file of
            each reader, so that no reader can lack it or have another one.
        image: format of reduced images; None: none is reduced.
    """

    encoding: Encoding
    channels: tuple[Channel, ...]
    is_compressed: bool = False
    dictionary: bytes = b""
    image: PictureFormat | None = None

    @property
    def steps(self) -> Step:
        """Return the steps that messages may state."""
        zstd = Step.ZSTD if self.is_compressed else Step(0)
        return zstd | Step.IMAGE if self.image else zstd

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
        fields: dict[str, Value] = {"e": self.encoding, "c": [channel.to_wire() for channel in self.channels]}
        if self.is_compressed:
            fields["z"] = "zstd"
        if self.dictionary:
            fields["d"] = self.dictionary
        if self.image:
            fields["i"] = self.image
        wire = encode(fields)
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
            case {"e": str(encoding), "c": [*channels], **more} if (
                encoding in _ENCODINGS and 0 < len(channels) <= CHANNELS_MAX
            ):
                wires = [each for each in channels if isinstance(each, bytes)]
                if len(wires) == len(channels):
                    described = tuple(map(Channel.from_wire, wires))
                    description = cls(_ENCODINGS[encoding], described, *_reductions(more))
                    if description.definitions_bytes <= DEFINITION_MAX_BYTES:
                        return description
        raise RemoteError(DropReason.MALFORMED, "description")


def _reductions(fields: Mapping[object, object]) -> tuple[bool, bytes, PictureFormat | None]:
    """Return whether bodies are compressed, the dictionary, and the image format."""
    codec, dictionary, image = fields.get("z"), fields.get("d", b""), fields.get("i")
    if codec not in (None, "zstd"):
        raise RemoteError(DropReason.BAD_VERSION, f"a codec that is unknown here: {str(codec)[:40]}")
    if image is not None and not (isinstance(image, str) and image in _IMAGES):
        raise RemoteError(DropReason.BAD_VERSION, f"an image format that is unknown here: {str(image)[:40]}")
    if not isinstance(dictionary, bytes) or len(dictionary) > DICTIONARY_MAX_BYTES:
        raise RemoteError(DropReason.MALFORMED, "dictionary")
    return codec is not None, dictionary, None if image is None else _IMAGES[image]
