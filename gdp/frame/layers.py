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
    XByteField,
    XLongField,
    XShortField,
    XStrFixedLenField,
)
from scapy.layers.l2 import Ether
from scapy.packet import Packet, bind_layers
from scapy.utils import strxor

from gdp.errors import LocalError
from gdp.frame.codec import HEADER_BYTES, HOPS_MASK, SECOND_PATH
from gdp.frame.diagnostic import byte_string, diagnose
from gdp.frame.kinds import CONTROL_FROM, ETHERTYPE, VERSION, Flag, Kind
from gdp.limits import HOPS_MAX
from gdp.names import NAME_BYTES, ZERO, Name

__all__ = ["GDP", "Cookie", "Keepalive", "Statement", "layout"]

KIND_NAMES: Final = {int(kind): kind.name.lower().replace("_", "-") for kind in Kind}
FLAG_NAMES: Final = [next((f.name.lower() for f in Flag if f.name and f == 1 << bit), f"bit{bit}") for bit in range(8)]
_NO_STATEMENTS: Final = frozenset({Kind.KEEPALIVE, Kind.COOKIE})  # of the kinds for the neighbour itself
_STATEMENTS: Final = frozenset(
    {Kind.RIB_REQUEST, Kind.RIB_ANSWER, *(kind for kind in Kind if kind >= CONTROL_FROM and kind not in _NO_STATEMENTS)}
)
_ANSWER_TO: Final = {Kind.RIB_ANSWER: Kind.RIB_REQUEST, Kind.ECHO_REPLY: Kind.ECHO_REQUEST}
_COSE_SIGN1: Final = 0xD284  # tag 18, an array of four
_LENGTH_AT: Final = 6
_KEEPALIVE_BYTES: Final = 47
_COOKIE_BYTES: Final = 32


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
        IntField("parts", 1),
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
        if self.version == VERSION and self.kind in _STATEMENTS and self.parts == 1 and _is_statement(payload):
            return Statement
        if self.version == VERSION and self.kind == Kind.KEEPALIVE and len(payload) >= _KEEPALIVE_BYTES:
            return Keepalive
        if self.version == VERSION and self.kind == Kind.COOKIE and len(payload) >= _COOKIE_BYTES:
            return Cookie
        return conf.raw_layer

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
