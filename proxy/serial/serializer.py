"""Serializer of one channel's messages in one encoding: from ROS's bytes to a body for the overlay, and back.

Sans-I/O. Each channel is compiled once.
Source: docs/explanation/design.md, section 8;
OMG CDR encapsulation (RTPS 2.2, section 10): two bytes of scheme, two of options.
"""

from __future__ import annotations

import struct
from typing import Final, Literal, TypeAlias

import cbor2
import orjson
import pybase64

from gdp.crypto.schema import Form, literal
from gdp.errors import DropReason, RemoteError
from proxy.serial.bounded_cache import BoundedCache, digest_of
from proxy.serial.cbor_bounds import check_bounds
from proxy.serial.cbor_dialect import CborDialect
from proxy.serial.channel import Channel
from proxy.serial.dialect import Dialect, MisfitError, Wide
from proxy.serial.layout import Wire
from proxy.serial.native_dialect import NativeDialect
from proxy.serial.reader import ITEMS_MAX, Reader, read_with
from proxy.serial.schema import Array as ArrayType
from proxy.serial.schema import DefinitionError, Record, Sequence, Text, Type, parse
from proxy.serial.writer import Writer, write_with

_LITTLE: Final = b"\x00\x01"  # CDR_LE
_BIG: Final = b"\x00\x00"  # CDR_BE
_PREFIX: Final = b"\x00\x01\x00\x00"
_PAD_MAX: Final = 3  # bytes that a writer may add to reach a multiple of four
_RAW: Final = "$raw"  # no field can have this name
_NATIVE: Final = NativeDialect()
_CONTAINERS_MAX: Final = 4 * ITEMS_MAX  # brackets in JSON; texts may contain some of them
_CBOR_ITEMS_MAX: Final = 8 * ITEMS_MAX  # numbers count too
_CODECS_MAX: Final = 256  # compiled types, of all encodings


# Encoding of a body; ``cdr``: the unchanged bytes of either ROS.
Encoding: TypeAlias = Literal["json", "cbor", "cdr"]
ENCODING: Final[Form[Encoding]] = literal("json", "cbor", "cdr")


class Serializer:
    """Bodies of one channel in one encoding.

    A message that does not fit the channel's definition, and every message of a channel without one, travels opaque:
    ``{"$raw": bytes}``. Nothing is lost; only the readable form is.
    """

    __slots__ = ("_codec", "_encoding", "channel", "opaque")

    def __init__(self, channel: Channel, encoding: Encoding) -> None:
        self.channel = channel
        self._encoding = encoding
        self.opaque = ""  # why messages travel opaque, empty where they do not
        self._codec: Codec | None = None
        if encoding != "cdr":
            try:
                self._codec = _codec(channel, encoding)
            except DefinitionError as error:
                self.opaque = str(error)

    def encode(self, raw: bytes) -> bytes:
        """Return the body of a message.

        Args:
            raw: the message in the channel's ROS version's wire form; CDR with its four bytes of encapsulation.
        """
        if self._encoding == "cdr":
            return raw
        tree = self._codec.to_tree(raw) if self._codec else None
        if self._encoding == "json":
            if tree is None:
                tree = {_RAW: pybase64.b64encode_as_string(raw)}
            return orjson.dumps(tree, option=orjson.OPT_SERIALIZE_NUMPY)
        return cbor2.dumps({_RAW: raw} if tree is None else tree)

    def decode(self, body: bytes) -> bytes:
        """Return the message of a body: little-endian CDR, padding zeroed, or ROS 1.

        Raises:
            RemoteError: the body does not fit the definition and the encoding.
        """
        if self._encoding == "cdr":
            return body
        try:
            tree = _json(body) if self._encoding == "json" else _cbor(body)
            if isinstance(tree, dict) and _RAW in tree:
                return _raw_of(tree[_RAW])
            if self._codec is None:
                raise MisfitError("a channel without a usable definition")
            return self._codec.to_raw(tree)
        except (
            ArithmeticError,
            LookupError,
            RecursionError,
            TypeError,
            ValueError,
            cbor2.CBORDecodeError,
            struct.error,
        ) as error:
            detail = f"{self._encoding}: {type(error).__name__}: {error}"[:200]
            raise RemoteError(DropReason.MALFORMED, detail) from error


def canonical(channel: Channel, raw: bytes) -> bytes:
    """Return the message read and written once: little-endian, padding zeroed, nothing after the last field.

    A message that does not fit the definition is returned unchanged.
    """
    try:
        codec = native_codec(channel)
    except DefinitionError:
        return raw
    tree = codec.to_tree(raw)
    return raw if tree is None else codec.to_raw(tree)


def native_codec(channel: Channel) -> Codec:
    """Return the codec whose trees hold numbers as bits, texts and arrays of numbers as memoryviews.

    Raises:
        DefinitionError: the channel has no usable definition.
    """
    return _native(channel.type_name, channel.definition, channel.definition_format, channel.ros)


def _json(body: bytes) -> object:
    if body.count(b"{") + body.count(b"[") > _CONTAINERS_MAX:
        raise MisfitError(f"more than {_CONTAINERS_MAX} maps and arrays")
    value: object = orjson.loads(body)
    return value


def _cbor(body: bytes) -> object:
    check_bounds(body, _CBOR_ITEMS_MAX)
    value: object = cbor2.loads(body)
    return value


def _raw_of(value: object) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, str):
        return pybase64.b64decode(value, validate=True)
    raise MisfitError("not bytes")


class Codec:
    """Readers for each wire form of the type, and the one writer; each is compiled when it is needed."""

    __slots__ = ("_dialect", "_layouts", "_readers", "_record", "_ros", "_turned", "_writer")

    def __init__(self, record: Record, ros: int, dialect: Dialect, turned: Codec | None) -> None:
        self._record = record
        self._ros = ros
        self._dialect = dialect
        self._turned = turned  # reads big-endian messages; None where this one does itself
        self._layouts = tuple(Wide) if _has_wide(record, set()) else (Wide.FOUR,)
        self._readers: dict[tuple[bytes, Wide], Reader] = {}
        self._writer: Writer | None = None

    def to_tree(self, raw: bytes) -> object | None:
        """Return the tree of a message, None where it does not fit the type."""
        if self._ros == 1:
            return self._first_fit(_LITTLE, memoryview(raw), 0)
        if len(raw) < len(_PREFIX):
            return None
        order = raw[:2]
        if order == _BIG and self._turned is not None:
            tree = self._turned.to_tree(raw)
            return None if tree is None else self.to_tree(self._turned.to_raw(tree))
        if order not in (_LITTLE, _BIG):
            return None
        return self._first_fit(order, memoryview(raw)[len(_PREFIX) :], _PAD_MAX)

    def to_raw(self, tree: object) -> bytes:
        """Return the message of a tree; raises the writer's errors."""
        body = bytearray()
        if self._writer is None:
            self._writer = write_with(self._record, Wire(cdr=self._ros == 2), self._dialect)
        self._writer(body, tree)
        return bytes(body) if self._ros == 1 else b"".join((_PREFIX, body))

    def _first_fit(self, order: bytes, body: memoryview, pad_max: int) -> object | None:
        for layout in self._layouts:
            try:
                tree, end = self._reader(order, layout)(body, 0)
            except (MisfitError, struct.error):
                continue
            if end <= len(body) <= end + pad_max:
                return tree
        return None

    def _reader(self, order: bytes, layout: Wide) -> Reader:
        key = (order, layout)
        if key not in self._readers:
            wire = Wire(cdr=self._ros == 2, order=">" if order == _BIG else "<")
            self._readers[key] = read_with(self._record, wire, self._dialect, layout)
        return self._readers[key]


def _has_wide(kind: Type, seen: set[int]) -> bool:
    if isinstance(kind, Text):
        return kind.wide
    if isinstance(kind, ArrayType | Sequence):
        return _has_wide(kind.item, seen)
    if not isinstance(kind, Record) or id(kind) in seen:
        return False
    seen.add(id(kind))
    return any(_has_wide(field, seen) for _, field in kind.fields)


def _native(type_name: str, definition: str, definition_format: str, ros: int) -> Codec:
    def build() -> Codec:
        return Codec(parse(type_name, definition, definition_format, ros), ros, _NATIVE, None)

    return _codecs.get(digest_of("native", type_name, definition, definition_format, ros), build)


def _dialect(encoding: Encoding) -> Dialect:
    if encoding != "json":
        return CborDialect()
    from proxy.serial.json_dialect import JsonDialect  # it loads NumPy

    return JsonDialect()


def _codec(channel: Channel, encoding: Encoding) -> Codec:
    named = (channel.type_name, channel.definition, channel.definition_format, channel.ros)

    def build() -> Codec:
        return Codec(parse(*named), channel.ros, _dialect(encoding), _native(*named))

    return _codecs.get(digest_of(encoding, *named), build)


_codecs: Final = BoundedCache[Codec](_CODECS_MAX, DefinitionError)
