"""Scapy layers of the frame: the normative definition.

Sans-I/O; for people, for tests and for the ``scapy`` data plane; no data path imports it. Source: ``spec.md`` in this
folder; IEEE 802-2014, clause 9.2.4 (local experimental EtherTypes); COSE_Sign1, RFC 9052, section 4.2.
``gdp/frame/codec.py`` is the fast twin of ``GDP``; generated tests compare the two.

    >>> Ether(dst="02:00:00:00:00:02") / GDP(kind="echo-request", destination="75e0…") / b"hello"
"""

from __future__ import annotations

from typing import Final

from scapy.config import conf
from scapy.fields import (
    ByteEnumField,
    ByteField,
    Field,
    FlagsField,
    IntField,
    LongField,
    ShortField,
    StrField,
    ThreeBytesField,
    XByteField,
    XLongField,
    XShortField,
    XStrField,
    XStrFixedLenField,
)
from scapy.layers.l2 import Ether
from scapy.packet import Packet, bind_layers
from scapy.utils import strxor

from gdp.errors import LocalError
from gdp.frame.codec import CONTROL_FROM, ETHERTYPE, HEADER_BYTES, HOPS_MASK, SECOND_PATH, VERSION, Flag, Kind
from gdp.frame.diagnostic import byte_string, diagnose
from gdp.limits import HOPS_MAX
from gdp.names import NAME_BYTES, ZERO, Name

KIND_NAMES: Final = {int(kind): kind.name.lower().replace("_", "-") for kind in Kind}
FLAG_NAMES: Final = [next((f.name.lower() for f in Flag if f.name and f == 1 << bit), f"bit{bit}") for bit in range(8)]
_NO_STATEMENTS: Final = frozenset({Kind.KEEPALIVE, Kind.COOKIE})  # of the kinds for the neighbour itself
STATEMENTS: Final = frozenset(
    {
        Kind.RIB_REQUEST,
        Kind.RIB_ANSWER,
        Kind.RELOCATE,
        Kind.DIAGNOSTIC_REQUEST,
        Kind.DIAGNOSTIC_REPLY,
        *(kind for kind in Kind if kind >= CONTROL_FROM and kind not in _NO_STATEMENTS),
    }
)
_ANSWER_TO: Final = {
    Kind.RIB_ANSWER: Kind.RIB_REQUEST,
    Kind.ECHO_REPLY: Kind.ECHO_REQUEST,
    Kind.DIAGNOSTIC_REPLY: Kind.DIAGNOSTIC_REQUEST,
}
_COSE_SIGN1: Final = 0xD284  # tag 18, an array of four
_LENGTH_AT: Final = 6
_SALT_BYTES: Final = 8
_TAG_BYTES: Final = 16


class NameField(XStrFixedLenField):
    """A name of 32 bytes; accepts 64 hex digits too, and shows them."""

    def __init__(self, name: str) -> None:
        super().__init__(name, bytes(ZERO), length=NAME_BYTES)

    def any2i(self, _pkt: Packet | None, x: object) -> bytes:
        """Return the 32 bytes of a name given as bytes or as hex digits.

        Raises:
            LocalError: another type, or not 32 bytes.
        """
        if isinstance(x, str):
            return bytes(Name.from_text(x))
        if isinstance(x, bytes):
            return bytes(Name(x))
        raise LocalError(f"a name is given as bytes or hex digits, not {type(x).__name__}")


class HopsField(ByteField):
    """Hops left in the lower seven bits; the highest bit marks the copy for the second path."""

    def i2repr(self, _pkt: Packet | None, x: int) -> str:
        """Return the hops left, and a word about the second path where the bit is set."""
        return f"{x & HOPS_MASK} (second path)" if x & SECOND_PATH else str(x)


class CborBytesField(StrField):
    """A CBOR byte string; the value excludes its head, and diagnostic notation shows it if it holds CBOR."""

    def getfield(self, _pkt: Packet, s: bytes) -> tuple[bytes, bytes]:
        """Return the bytes behind the string, and its content.

        Raises:
            ValueError: there is no complete byte string.
        """
        start, end = byte_string(s)
        return s[end:], s[start:end]

    def addfield(self, _pkt: Packet, s: bytes, val: bytes | None) -> bytes:
        """Return ``s`` with the string appended in its shortest form, up to 65,535 bytes."""
        value = val or b""
        size = len(value)
        if size < 24:
            return s + bytes([0x40 | size]) + value
        if size < 1 << 8:
            return s + b"\x58" + size.to_bytes(1, "big") + value
        return s + b"\x59" + size.to_bytes(2, "big") + value

    def i2repr(self, _pkt: Packet | None, x: bytes) -> str:
        """Return the diagnostic notation, or hex digits where the content is no CBOR."""
        return diagnose(x) or f"h'{x.hex()}'"


class RestField(XStrField):
    """All bytes up to the fields behind it.

    Args:
        behind: bytes of the fields behind it.
        least: fewest bytes of its own.
    """

    __slots__ = ("behind", "least")

    def __init__(self, name: str, *, behind: int = 0, least: int = 0) -> None:
        super().__init__(name, b"")
        self.behind = behind
        self.least = least

    def getfield(self, _pkt: Packet, s: bytes) -> tuple[bytes, bytes]:
        """Return the bytes behind the field, and its own."""
        end = len(s) - self.behind
        return s[end:], s[:end]


class GDP(Packet):
    """The 96-byte header; ``length`` is filled in, and bytes behind the payload are Ethernet padding."""

    name = "GDP"
    fields_desc = [  # noqa: RUF012  (the form that Scapy prescribes)
        ByteField("version", VERSION),
        ByteEnumField("kind", Kind.DATA, KIND_NAMES),
        FlagsField("flags", 0, 8, FLAG_NAMES),
        HopsField("hops_left", HOPS_MAX),
        ShortField("epoch", 0),
        ShortField("length", None),
        LongField("number", 0),
        IntField("part", 0),
        ByteField("pace", 0),
        ThreeBytesField("parts", 1),
        XLongField("incarnation", 0),
        NameField("destination"),
        NameField("source"),
    ]

    @classmethod
    def dispatch_hook(cls, _pkt: bytes | None = None, *_args: object, **_kwargs: object) -> type[Packet]:
        """Show a frame that is shorter than a header as raw bytes."""
        return conf.raw_layer if _pkt is not None and len(_pkt) < HEADER_BYTES else cls

    def post_build(self, pkt: bytes, pay: bytes) -> bytes:
        """Fill in the payload length, unless it was given."""
        if self.length is None:
            pkt = pkt[:_LENGTH_AT] + len(pay).to_bytes(2, "big") + pkt[_LENGTH_AT + 2 :]
        return pkt + pay

    def extract_padding(self, s: bytes) -> tuple[bytes, bytes]:
        """Split the payload from the Ethernet padding behind it."""
        return s[: self.length], s[self.length :]

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Return the layer of the payload; raw bytes where it is malformed or of another kind."""
        if self.version != VERSION:
            return conf.raw_layer
        if self.kind in STATEMENTS:
            return Statement if self.parts == 1 and _is_statement(payload) else conf.raw_layer
        layer = PAYLOADS[self.kind][bool(self.flags & Flag.LAST)] if self.kind in PAYLOADS else None
        return layer if layer is not None and len(payload) >= least_bytes(layer) else conf.raw_layer

    def hashret(self) -> bytes:
        """Return the key that a query and its response share; that of an echo includes its number."""
        asked = _ANSWER_TO.get(self.kind, self.kind)
        number = int(self.number).to_bytes(8, "big") if asked == Kind.ECHO_REQUEST else b""
        return bytes([asked]) + number + bytes(strxor(self.destination, self.source))

    def answers(self, other: Packet) -> bool:
        """Return whether this is the response to ``other``: its names are swapped; an echo keeps its number.

        A RIB numbers its responses itself, since one query may have several.
        """
        return (
            isinstance(other, GDP)
            and _ANSWER_TO.get(self.kind) == other.kind
            and (self.kind != Kind.ECHO_REPLY or self.number == other.number)
            and self.destination == other.source
            and self.source == other.destination
        )

    def mysummary(self) -> str:
        """Return the line that Scapy shows for the frame."""
        source, destination = Name(self.source).short, Name(self.destination).short
        which = f"#{self.number} {self.part + 1}/{self.parts}"
        return f"GDP {self.sprintf('%kind%')} {source} > {destination} {which} hops {self.sprintf('%hops_left%')}"


class Keepalive(Packet):
    """The payload of a keepalive: its fields, and the tag of the two sessions' key (``control/keepalive.py``)."""

    name = "GDP keepalive"
    fields_desc = [  # noqa: RUF012  (the form that Scapy prescribes)
        FlagsField("flags", 0, 8, ["poll", "final", "heard", "bit3", "bit4", "bit5", "bit6", "bit7"]),
        ByteField("multiplier", 3),
        XStrFixedLenField("digest", bytes(8), length=8),
        LongField("sent", 0),
        LongField("echo", 0),
        IntField("held_us", 0),
        ByteField("loss", 0),
        XStrFixedLenField("tag", bytes(16), length=16),
    ]


class Cookie(Packet):
    """The payload of a cookie: both ports' sessions, and the cookie for the next hello (``control/admission.py``)."""

    name = "GDP cookie"
    fields_desc = [  # noqa: RUF012  (the form that Scapy prescribes)
        XStrFixedLenField("session", bytes(8), length=8),
        XStrFixedLenField("nonce", bytes(8), length=8),
        XStrFixedLenField("cookie", bytes(16), length=16),
    ]


class Part(Packet):
    """The payload of a part of a sealed message that is not its last (``crypto/envelope.py``)."""

    name = "GDP sealed part"
    fields_desc = [  # noqa: RUF012
        XStrFixedLenField("salt", bytes(_SALT_BYTES), length=_SALT_BYTES),
        RestField("ciphertext", behind=_TAG_BYTES),
        XStrFixedLenField("tag", bytes(_TAG_BYTES), length=_TAG_BYTES),
    ]


class LastPart(Packet):
    """The payload of the last part: ciphertext, tag, and the signature unless the stream has a session secret.

    Only the ends of a stream know whether it is signed.
    """

    name = "GDP last sealed part"
    fields_desc = [  # noqa: RUF012
        XStrFixedLenField("salt", bytes(_SALT_BYTES), length=_SALT_BYTES),
        RestField("sealed", least=_TAG_BYTES),
    ]


class Note(Packet):
    """Payload of an AckNack or introduction: the topic in plain, and the rest sealed (``crypto/control_seal.py``)."""

    name = "GDP note"
    fields_desc = [  # noqa: RUF012
        NameField("topic"),
        RestField("ciphertext", behind=_TAG_BYTES),
        XStrFixedLenField("tag", bytes(_TAG_BYTES), length=_TAG_BYTES),
    ]


class ParityFrame(Packet):
    """The payload of a parity frame, which is sealed as a whole (``crypto/parity_seal.py``)."""

    name = "GDP parity"
    fields_desc = [  # noqa: RUF012
        RestField("ciphertext", behind=_TAG_BYTES),
        XStrFixedLenField("tag", bytes(_TAG_BYTES), length=_TAG_BYTES),
    ]


class Statement(Packet):
    """A COSE_Sign1 statement of one fragment; each fragment of a longer one is shown raw."""

    name = "Statement"
    fields_desc = [  # noqa: RUF012
        XShortField("cose", _COSE_SIGN1),
        CborBytesField("protected", b""),
        XByteField("unprotected", 0xA0),
        CborBytesField("body", b""),
        CborBytesField("signature", b""),
    ]


# by kind: layer of a payload without the flag *last*, and with it
PAYLOADS: Final[dict[int, tuple[type[Packet], type[Packet]]]] = {
    Kind.DATA: (Part, LastPart),
    Kind.HEARTBEAT: (Part, LastPart),
    Kind.ACKNACK: (Note, Note),
    Kind.INTRODUCTION: (Note, Note),
    Kind.PARITY: (ParityFrame, ParityFrame),
    Kind.KEEPALIVE: (Keepalive, Keepalive),
    Kind.COOKIE: (Cookie, Cookie),
}


def least_bytes(layer: type[Packet]) -> int:
    """Return the bytes of the shortest payload that a layer of ``PAYLOADS`` shows."""
    return len(layer()) + sum(field.least for field in layer.fields_desc if isinstance(field, RestField))


def _is_statement(payload: bytes) -> bool:
    """Return whether the payload is well-formed and has the form of the ``Statement`` layer."""
    if payload[:2] != _COSE_SIGN1.to_bytes(2, "big") or diagnose(payload) is None:
        return False
    try:
        rest = payload[2 + byte_string(payload[2:])[1] :]
        rest = rest[1 + byte_string(rest[1:])[1] :] if rest[:1] == b"\xa0" else b""
        return byte_string(rest)[1] == len(rest)
    except ValueError:
        return False


def layout() -> dict[str, tuple[int, int]]:
    """Return offset and size in bytes of every header field; the codec must agree with them."""
    places: dict[str, tuple[int, int]] = {}
    at = 0
    for field in GDP.fields_desc:
        assert isinstance(field, Field)
        size = NAME_BYTES if isinstance(field, NameField) else int(field.sz)
        places[field.name] = (at, size)
        at += size
    return places


bind_layers(Ether, GDP, type=ETHERTYPE)
