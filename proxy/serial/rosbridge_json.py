"""Messages as rosbridge writes them: in JSON, with octets as base64 and null for infinities and NaN; in CBOR; in PNG.

Sans-I/O. Source: the rosbridge v2 protocol, section 3 (data encoding); ``message_conversion.py`` of rosbridge_library:
stamps also as ``secs`` and ``nsecs`` or ``"now"``, and a header without a stamp has the present time.
"""

from __future__ import annotations

import struct
import zlib
from base64 import b64encode
from math import isqrt
from typing import Final

import cbor2
import orjson

from gdp.errors import DropReason, LocalError, RemoteError
from proxy.serial.bounded_cache import BoundedCache, digest_of
from proxy.serial.cbor_dialect import CborDialect
from proxy.serial.channel import Channel
from proxy.serial.dialect import MisfitError
from proxy.serial.json_dialect import JsonDialect
from proxy.serial.schema import Array, Number, Record, Sequence, Text, Type, parse
from proxy.serial.serializer import Codec, native_codec

_NAN: Final = {"f": 0x7FC00000, "d": 0x7FF8000000000000}
_TIME, _DURATION, _HEADER = "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration", "std_msgs/msg/Header"
_SPELLINGS: Final = (("sec", "secs"), ("nanosec", "nsecs"))  # ROS 2's and ROS 1's
_DUMMY: Final = "structure_needs_at_least_one_member"  # rosidl's field of an empty type


class _Dialect(JsonDialect):
    """JSON of rosbridge: plain integers of any size, null for NaN and infinities, octets also as a list."""

    guarded = ""

    def number(self, code: str, value: float, bits: int) -> object:
        """Return a number, or None for an infinity or NaN."""
        written = super().number(code, value, bits)
        return (None if code in _NAN else value) if isinstance(written, str) else written

    def bits(self, code: str, value: object) -> int | bool:
        """Return the value to pack; None is a NaN."""
        if value is None and code in _NAN:
            return _NAN[code]
        if code == "?" and value in (0, 1):
            return bool(value)
        return super().bits(code, value)

    def array(self, item: Number, raw: memoryview) -> object:
        """Return base64 for octets, else a list."""
        written = super().array(item, raw)
        if not isinstance(written, list) or item.code == "?":
            return written
        if item.code in _NAN:
            return [None if isinstance(each, str) else each for each in written]
        return [int(each) if isinstance(each, str) else each for each in written]

    def unarray(self, item: Number, value: object) -> bytes | memoryview:
        """Return the bytes of a list or of base64; None in a list of floats is a NaN."""
        if item.octet and isinstance(value, list):
            return bytes(value)
        if isinstance(value, list) and None in value and item.code in _NAN:
            nan = float("nan")
            value = [nan if each is None else each for each in value]
        return super().unarray(item, value)


class _Cbor(CborDialect):
    """CBOR of rosbridge: octets as a byte string, and every float as CBOR's own."""

    def number(self, code: str, value: float, bits: int) -> object:
        """Return a number."""
        del code, bits
        return value

    def array(self, item: Number, raw: memoryview) -> object:
        """Return a byte string for octets, else a typed array or a list."""
        return bytes(raw) if item.octet else super().array(item, raw)


class RosbridgeCodec:
    """Converter between a channel's CDR and rosbridge's JSON.

    Raises:
        DefinitionError: the channel has no usable definition.
    """

    def __init__(self, channel: Channel) -> None:
        self._name = channel.type_name
        self._record = parse(channel.type_name, channel.definition, channel.definition_format, 2)
        self._codec = Codec(self._record, 2, _Dialect(), native_codec(channel))
        self._cbor = Codec(self._record, 2, _Cbor(), native_codec(channel))

    @property
    def field_names(self) -> list[str]:
        """Return the fields in order."""
        return [name for name, _ in self._record.fields if name != _DUMMY]

    def to_json(self, raw: bytes) -> bytes:
        """Return the message as JSON. Raises ``RemoteError``: it does not fit the definition."""
        return orjson.dumps(self._tree(self._codec, raw), option=orjson.OPT_SERIALIZE_NUMPY)

    def to_cbor(self, topic: str, raw: bytes) -> bytes:
        """Return ``publish`` of a subscription with the compression ``cbor``.

        Raises:
            RemoteError: the message does not fit the definition.
        """
        return cbor2.dumps({"op": "publish", "topic": topic, "msg": self._tree(self._cbor, raw)})

    def to_raw(self, tree: object, now_ns: int = 0) -> bytes:
        """Return the CDR of a client's message; fields that it leaves out are zero, empty or false.

        Args:
            now_ns: the present time, Unix nanoseconds: of ``"now"`` and of headers without a stamp.

        Raises:
            RemoteError: it does not fit the definition.
        """
        try:
            return self._codec.to_raw(_filled(self._record, tree, self._name, now_ns))
        except (ArithmeticError, LookupError, TypeError, ValueError, struct.error, RecursionError) as error:
            raise RemoteError(DropReason.MALFORMED, f"{self._name}: {error}"[:300]) from error

    def _tree(self, codec: Codec, raw: bytes) -> object:
        tree = codec.to_tree(raw)
        if tree is None:
            raise RemoteError(DropReason.MALFORMED, f"a message that does not fit {self._name}")
        if isinstance(tree, dict):
            tree.pop(_DUMMY, None)
        return tree


_codecs: Final = BoundedCache[RosbridgeCodec](256, LocalError)


def codec_of(channel: Channel) -> RosbridgeCodec:
    """Return the converter of a type. Raises ``LocalError``: it has no usable definition."""
    key = digest_of("rosbridge", channel.type_name, channel.definition, channel.definition_format, 2)
    return _codecs.get(key, lambda: RosbridgeCodec(channel))


def both_spellings(now_ns: int) -> dict[str, int]:
    """Return a time as clients of ROS 2 and of ROS 1 read it."""
    time = _time(now_ns)
    return time | {one: time[two] for two, one in _SPELLINGS}


def png_text(wire: bytes) -> str:
    """Return a text as the pixels of a PNG image, filled up with newlines, in base64."""
    width = max(isqrt(len(wire) // 3), 1)
    height = -(-len(wire) // (3 * width))
    pixels = wire.ljust(3 * width * height, b"\n")
    rows = b"".join(b"\0" + pixels[at : at + 3 * width] for at in range(0, len(pixels), 3 * width))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits of red, green and blue
    kinds = ((b"IHDR", head), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b""))
    parts = [(len(data), kind + data) for kind, data in kinds]
    chunks = [struct.pack(">I", size) + part + struct.pack(">I", zlib.crc32(part)) for size, part in parts]
    return b64encode(b"\x89PNG\r\n\x1a\n" + b"".join(chunks)).decode()


def cbor_raw(topic: str, stamp_ns: int, raw: bytes) -> bytes:
    """Return a message of a subscription with the compression ``cbor-raw``: the bytes as ROS wrote them."""
    secs, nsecs = divmod(stamp_ns, 1_000_000_000)
    return cbor2.dumps({"op": "publish", "topic": topic, "msg": {"secs": secs, "nsecs": nsecs, "bytes": raw}})


def _filled(kind: Type, value: object, where: str, now_ns: int) -> object:
    """Return a client's value with every field that it left out."""
    if isinstance(kind, Record):
        value = _stamped(kind, value, now_ns)
        if not isinstance(value, dict):
            raise MisfitError(f"{where}: an object was expected")
        names = [name for name, _ in kind.fields]
        if unknown := sorted(str(key) for key in value.keys() - set(names)):
            raise MisfitError(f"{where}: there is no field {unknown[0]}; it has {', '.join(names)}")
        return {
            name: _filled(field, value[name], f"{where}.{name}", now_ns) if name in value else _zero(field)
            for name, field in kind.fields
        }
    if isinstance(kind, Array | Sequence) and isinstance(kind.item, Record) and isinstance(value, list):
        return [_filled(kind.item, each, f"{where}[{index}]", now_ns) for index, each in enumerate(value)]
    return value


def _stamped(kind: Record, value: object, now_ns: int) -> object:
    """Return a time, a duration or a header in ROS 2's form; anything else as it is."""
    if kind.name == _TIME and value == "now":
        return _time(now_ns)
    if kind.name in (_TIME, _DURATION) and isinstance(value, dict):
        return {two: value[two if two in value else one] for two, one in _SPELLINGS if two in value or one in value}
    if kind.name == _HEADER and isinstance(value, dict):
        return {"stamp": _time(now_ns)} | {name: each for name, each in value.items() if name != "seq"}
    return value


def _time(now_ns: int) -> dict[str, int]:
    sec, nanosec = divmod(now_ns, 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def _zero(kind: Type) -> object:
    if isinstance(kind, Record):
        return {name: _zero(field) for name, field in kind.fields}
    if isinstance(kind, Text):
        return ""
    if isinstance(kind, Number):
        return False if kind.code == "?" else 0
    if isinstance(kind, Array):
        return [_zero(kind.item)] * kind.count
    return []
