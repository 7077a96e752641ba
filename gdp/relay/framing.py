"""Framing of Ethernet frames and control messages on a byte stream.

Sans-I/O. All numbers are in network byte order; a record never spans more than its length says::

    frame     0 length (15 bits)   frame: 14 bytes of Ethernet header, then a GDP header and its payload
    control   1 length (15 bits)   type (1)   body

    type 0    keepalive   no body
    type 1    open        MTU that the client wants (2): its first message
    type 2    accepted    MTU of the connection (2): the server's response
    type 3    refused     a sentence for people, UTF-8; the sender closes the connection after it
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gdp.errors import DropReason, FrameError
from gdp.frame.codec import ETHER_BYTES, ETHERTYPE, HEADER_BYTES

MTU_MIN: Final = 576
MTU_MAX: Final = 9_000
FRAME_MIN_BYTES: Final = ETHER_BYTES + HEADER_BYTES
PREFIX: Final = struct.Struct("!H")
_CONTROL: Final = 0x8000
_CONTROL_MAX_BYTES: Final = 512
_ETHERTYPE: Final = ETHERTYPE.to_bytes(2, "big")
_ETHERTYPE_AT: Final = slice(ETHER_BYTES - 2, ETHER_BYTES)


class ControlType(IntEnum):
    """Type of a control message."""

    KEEPALIVE = 0
    OPEN = 1
    ACCEPTED = 2
    REFUSED = 3


@dataclass(frozen=True, slots=True)
class ControlMessage:
    """A message between the two relays themselves."""

    type: ControlType
    body: bytes = b""

    @classmethod
    def with_mtu(cls, type_: ControlType, mtu: int) -> ControlMessage:
        """Return an ``OPEN`` or ``ACCEPTED`` message."""
        return cls(type_, PREFIX.pack(mtu))

    @classmethod
    def refusal(cls, sentence: str) -> ControlMessage:
        """Return a ``REFUSED`` message; a sentence that is too long is cut."""
        return cls(ControlType.REFUSED, sentence.encode()[: _CONTROL_MAX_BYTES - 1])

    def to_wire(self) -> bytes:
        """Return the record."""
        return PREFIX.pack(_CONTROL | 1 + len(self.body)) + bytes([self.type]) + self.body


KEEPALIVE: Final = ControlMessage(ControlType.KEEPALIVE).to_wire()


def mtu_of(message: ControlMessage) -> int:
    """Return the MTU in an ``OPEN`` or ``ACCEPTED`` message. Raises ``FrameError``: it is not one that a relay uses."""
    if len(message.body) != PREFIX.size:
        raise FrameError(DropReason.MALFORMED, "an MTU of another length")
    (mtu,) = PREFIX.unpack(message.body)
    if not MTU_MIN <= mtu <= MTU_MAX:
        raise FrameError(DropReason.MALFORMED, f"an MTU of {mtu}")
    return int(mtu)


def is_gdp_frame(frame: bytes | memoryview) -> bool:
    """Return whether a frame, from its Ethernet header on, has the project's EtherType and a whole header."""
    return len(frame) >= FRAME_MIN_BYTES and frame[_ETHERTYPE_AT] == _ETHERTYPE


class Deframer:
    """Parser of one stream, whatever the pieces in which it arrives; it buffers less than one record.

    Args:
        mtu: of the connection; a frame has at most the Ethernet header in addition.
    """

    def __init__(self, mtu: int = MTU_MAX) -> None:
        self._max_bytes = mtu + ETHER_BYTES
        self._rest = b""

    def receive_bytes(self, data: bytes) -> tuple[list[memoryview], list[ControlMessage]]:
        """Return the frames and the control messages that are now complete, each list in order.

        Raises:
            FrameError: TOO_BIG or MALFORMED; the stream is unusable after that.
        """
        if self._rest:
            data = self._rest + data
        view = memoryview(data)
        frames: list[memoryview] = []
        controls: list[ControlMessage] = []
        at, end, limit = 0, len(data), self._max_bytes
        while end - at >= 2:
            length = data[at] << 8 | data[at + 1]
            if length < _CONTROL:
                if length > limit:
                    raise FrameError(DropReason.TOO_BIG, f"a frame of {length} bytes, of at most {limit}")
                if not length:
                    raise FrameError(DropReason.MALFORMED, "an empty frame")
                until = at + 2 + length
                if until > end:
                    break
                frames.append(view[at + 2 : until])
            else:
                until = at + 2 + _control_length(length)
                if until > end:
                    break
                controls.append(_control(data[at + 2 : until]))
            at = until
        self._rest = data[at:]
        return frames, controls


def _control_length(prefix: int) -> int:
    length = prefix & ~_CONTROL
    if not 0 < length <= _CONTROL_MAX_BYTES:
        raise FrameError(DropReason.TOO_BIG, f"a control message of {length} bytes, of at most {_CONTROL_MAX_BYTES}")
    return length


def _control(record: bytes) -> ControlMessage:
    try:
        return ControlMessage(ControlType(record[0]), record[1:])
    except ValueError as error:
        raise FrameError(DropReason.MALFORMED, f"a control message of type {record[0]}") from error
