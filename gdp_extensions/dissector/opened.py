"""Scapy layers of opened messages, as ``gdp decrypt-pcap`` writes them for Wireshark; they are never on a wire.

Sans-I/O; for people. Source: ``spec.md`` in this folder, which describes each body.
"""

from __future__ import annotations

from typing import Final

from scapy.config import conf
from scapy.fields import (
    ByteEnumField,
    ByteField,
    FlagsField,
    IntField,
    LongField,
    ShortField,
    XLongField,
    XStrFixedLenField,
)
from scapy.packet import Packet

from gdp.frame.codec import Kind
from gdp.frame.layers import FLAG_NAMES, KIND_NAMES, NameField, RestField, least_bytes

ENCODINGS: Final = {0: "unknown", 1: "json", 2: "cbor", 3: "cdr"}


class OpenedFrame(Packet):
    """Facts of a message from the headers of its frames; its plaintext follows."""

    name = "GDP opened message"
    fields_desc = [  # noqa: RUF012  (the form that Scapy prescribes)
        ByteEnumField("kind", Kind.DATA, KIND_NAMES),
        FlagsField("flags", 0, 8, FLAG_NAMES),
        ShortField("epoch", 0),
        IntField("parts", 1),
        LongField("number", 0),
        XLongField("incarnation", 0),
        NameField("destination"),
        NameField("source"),
        NameField("topic"),
        LongField("sequence", 0),
        IntField("restored", 0),
        ByteEnumField("encoding", 0, ENCODINGS),
    ]

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Return the layer of the plaintext; raw bytes where its kind has none, or it is too short."""
        layer = BODIES.get(self.kind)
        if self.kind == Kind.DATA and not self.encoding:
            return conf.raw_layer
        return layer if layer is not None and len(payload) >= least_bytes(layer) else conf.raw_layer


class RosBody(Packet):
    """A ROS message as a proxy publishes it."""

    name = "ROS message"
    fields_desc = [  # noqa: RUF012
        ByteField("version", 1),
        FlagsField("steps", 0, 8, ["image", "zstd", "bit2", "bit3", "bit4", "bit5", "bit6", "bit7"]),
        ByteField("channel", 0),
        LongField("stamp", 0),
        RestField("body"),
    ]


class HeartbeatBody(Packet):
    """A Heartbeat; starts, moves, ranges that are gone and the description are in ``rest``."""

    name = "GDP Heartbeat"
    fields_desc = [  # noqa: RUF012
        LongField("oldest", 0),
        LongField("oldest_sequence", 0),
        LongField("sent_number", 0),
        IntField("sent_part", 0),
        LongField("sent_sequence", 0),
        ShortField("starts", 0),
        ByteField("moves", 0),
        ByteField("gone", 0),
        RestField("rest"),
    ]


class IntroductionBody(Packet):
    """An introduction of a reader."""

    name = "GDP introduction"
    fields_desc = [  # noqa: RUF012
        LongField("started", 0),
        XStrFixedLenField("exchange", bytes(32), length=32),
        XStrFixedLenField("digest", bytes(32), length=32),
        XStrFixedLenField("key", bytes(33), length=33),
        XStrFixedLenField("signature", bytes(64), length=64),
    ]


class ParityBody(Packet):
    """A parity shard of one block."""

    name = "GDP parity shard"
    fields_desc = [  # noqa: RUF012
        IntField("first", 0),
        ByteField("index", 0),
        ByteField("count", 1),
        RestField("shard"),
    ]


BODIES: Final[dict[int, type[Packet]]] = {
    Kind.DATA: RosBody,
    Kind.HEARTBEAT: HeartbeatBody,
    Kind.INTRODUCTION: IntroductionBody,
    Kind.PARITY: ParityBody,
}
