"""Envelope of a ROS message inside a sealed message, and the description of a publisher's messages.

Sans-I/O. Wire form of a message, big-endian: ``version (1) | steps (1) | channel (1) | stamp in ns (8) | body``. The
bits of ``steps`` say what was done to the body (``Step``). A description is a map in deterministic CBOR: ``e`` the
encoding of all bodies, ``c`` the channels to which the messages' numbers refer, ``z`` the codec of compressed bodies,
``d`` its dictionary, ``i`` the format of reduced images. The last three are there only where a rule states them.
Invalid bytes raise ``RemoteError``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Annotated, Final, Literal, NamedTuple, TypeAlias, TypeVar

from gdp.crypto.cbor import Value
from gdp.crypto.schema import FieldSet, Form, Keyed, literal, many, mapped, octets
from gdp.errors import DropReason, LocalError, RemoteError, StatementError
from proxy.serial.channel import CHANNEL, Channel
from proxy.serial.schema import DEFINITION_MAX_BYTES, definition_bytes
from proxy.serial.serializer import ENCODING, Encoding

_T = TypeVar("_T")

VERSION: Final = 1
CHANNELS_MAX: Final = 256
DESCRIPTION_MAX_BYTES: Final = 4 << 20  # many channels of one topic may contain the same definition
_HEAD: Final = struct.Struct("!BBBQ")
HEAD_BYTES: Final = _HEAD.size


def _known(form: Form[_T], what: str) -> Form[_T]:
    """Return a form that a later version may extend: another value is of an unknown version, not malformed."""

    def read(value: Value) -> _T:
        try:
            return form.read(value)
        except ValueError as error:
            raise RemoteError(DropReason.BAD_VERSION, f"{what} that is unknown here: {str(value)[:40]}") from error

    return replace(form, read=read)


PictureFormat: TypeAlias = Literal["jpeg", "png"]
DICTIONARY_MAX_BYTES: Final = 32 << 10  # it travels to each reader within the description
_PICTURES: Final[Form[PictureFormat | None]] = literal("jpeg", "png")
_IMAGE: Final = _known(_PICTURES, "an image format")
_CODEC: Final = _known(mapped(literal("zstd"), lambda _: True, lambda _: "zstd"), "a codec")


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

    @property
    def head(self) -> bytes:
        """Return the wire form without the body, which follows."""
        return _HEAD.pack(VERSION, self.steps, self.channel, self.stamp_ns)

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return self.head + self.body

    @classmethod
    def from_wire(cls, wire: bytes, head: bytes = b"") -> RosMessage:
        """Read the wire form, of which ``head`` came apart: at most ``HEAD_BYTES``, and the body is not copied then."""
        begin = HEAD_BYTES - len(head)
        if len(wire) < begin:
            raise RemoteError(DropReason.MALFORMED, "parcel")
        version, steps, channel, stamp_ns = _HEAD.unpack(head + wire[:begin])
        if version != VERSION:
            raise RemoteError(DropReason.BAD_VERSION, f"parcel version {version}")
        if steps & ~_STEPS:
            raise RemoteError(DropReason.BAD_VERSION, f"steps {steps:#x} that are unknown here")
        return cls(channel, stamp_ns, wire[begin:], Step(steps))


@dataclass(frozen=True, slots=True)
class TopicDescription(FieldSet):
    """Description of the messages of one publisher of one topic.

    Attributes:
        is_compressed: whether bodies may be Zstandard frames.
        dictionary: of those frames, at most ``DICTIONARY_MAX_BYTES``; empty: none. It is here rather than in a file of
            each reader, so that no reader can lack it or have another one.
        image: format of reduced images; None: none is reduced.
    """

    MAX_BYTES = DESCRIPTION_MAX_BYTES
    encoding: Annotated[Encoding, Keyed("e", ENCODING)]
    channels: Annotated[tuple[Channel, ...], Keyed("c", many(CHANNEL, CHANNELS_MAX, is_cut=False))]
    is_compressed: Annotated[bool, Keyed("z", _CODEC, absent=False, is_omitted=True)] = False
    dictionary: Annotated[bytes, Keyed("d", octets(most=DICTIONARY_MAX_BYTES), absent=b"", is_omitted=True)] = b""
    image: Annotated[PictureFormat | None, Keyed("i", _IMAGE, absent=None, is_omitted=True)] = None

    @property
    def steps(self) -> Step:
        """Return the steps that messages may state."""
        zstd = Step.ZSTD if self.is_compressed else Step(0)
        return zstd | Step.IMAGE if self.image else zstd

    def to_wire(self) -> bytes:
        """Return the wire form. Raises ``LocalError``: too many channels, or too long descriptions."""
        if len(self.channels) > CHANNELS_MAX:
            raise LocalError(f"{len(self.channels)} connections of one topic; at most {CHANNELS_MAX} are allowed")
        if self.definitions_bytes > DEFINITION_MAX_BYTES:
            detail = f"definitions of {self.definitions_bytes} bytes; at most {DEFINITION_MAX_BYTES} are allowed"
            raise LocalError(detail)
        wire = self.to_cbor()
        if len(wire) > DESCRIPTION_MAX_BYTES:
            raise LocalError(f"a description of {len(wire)} bytes; at most {DESCRIPTION_MAX_BYTES} are allowed")
        return wire

    @property
    def definitions_bytes(self) -> int:
        """Return the length of all different definitions together."""
        return sum(map(definition_bytes, {channel.definition for channel in self.channels}))

    def check(self) -> None:
        """Return if there are channels, and not too long definitions. Raises ``StatementError``: MALFORMED."""
        if not self.channels or self.definitions_bytes > DEFINITION_MAX_BYTES:
            raise StatementError(DropReason.MALFORMED, "description")
