"""Empty message of a type: numbers are zero, texts and sequences have no length, unless the definition has defaults.

Sans-I/O. A client gets it if no answer arrives in time. A response with ``bool success`` and ``string message``, such
as those of ``std_srvs``, contains the reason instead. Fields that a far definition lacks get their values from it.
Source: FogROS2-FT: "an empty response" after the timeout of a request.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final, TypeAlias

from gdp.limits import MESSAGE_MAX_BYTES
from proxy.serial.channel import Channel, Service
from proxy.serial.cost import fixed_bytes, items_of
from proxy.serial.dialect import Wide
from proxy.serial.msg_text import Default
from proxy.serial.native_dialect import NativeDialect
from proxy.serial.reader import ITEMS_MAX
from proxy.serial.schema import Array, DefinitionError, Number, Record, Sequence, Text, Type, parse
from proxy.serial.serializer import Codec

Defaults: TypeAlias = "Mapping[tuple[str, str], Default]"  # by type and field

_SUCCESS: Final = ("success", Number("?"))
_MESSAGE: Final = ("message", Text())


class _Leaves(NativeDialect):
    inline_max = 0  # so that every array of numbers is written as bytes


_LEAVES: Final = _Leaves()
_SIGNED: Final = frozenset("bhiq")  # their bits are signed, those of others are not


class NoAnswer:
    """Response of a ROS 2 service that has no answer.

    Raises:
        DefinitionError: its definition cannot be read, or its fixed arrays are too large.

    Attributes:
        says_reason: whether the response has ``success`` and ``message``.
    """

    def __init__(self, response: Channel) -> None:
        record = parse(response.type_name, response.definition, response.definition_format, response.ros)
        _check_size(record)
        self._codec = Codec(record, response.ros, _LEAVES, None)
        self._record = record
        self.says_reason = {_SUCCESS, _MESSAGE} <= set(record.fields)

    @classmethod
    def of(cls, service: Service) -> NoAnswer | None:
        """Return the empty response of a service; None: ROS 1 has errors, or the response's definition is unknown."""
        if service.ros == 1:
            return None
        try:
            return cls(service.response)
        except DefinitionError:
            return None

    def to_raw(self, reason: str) -> bytes:
        """Return the message; it contains ``reason`` where the type has a field for it."""
        tree = _default(self._record, {})
        if self.says_reason:
            tree["message"] = memoryview(reason.encode())
        return self._codec.to_raw(tree)


def default_tree(record: Record, ros: int, defaults: Defaults) -> dict[str, object]:
    """Return the tree of an empty message as ``NativeDialect`` reads it.

    Raises:
        DefinitionError: it is too large, or a default does not fit its field.
    """
    _check_size(record)
    raw = Codec(record, ros, _LEAVES, None).to_raw(_default(record, defaults))
    tree = Codec(record, ros, NativeDialect(), None).to_tree(raw)
    if not isinstance(tree, dict):
        raise DefinitionError(f"{record.name}: a default that does not fit")
    return tree


def _check_size(record: Record) -> None:
    if fixed_bytes(record, {}) > MESSAGE_MAX_BYTES or items_of(record, {}) > ITEMS_MAX:
        raise DefinitionError(f"{record.name}: an empty message is too large")


def _default(record: Record, defaults: Defaults) -> dict[str, object]:
    tree = dict[str, object]()
    for name, kind in record.fields:
        value = defaults.get((record.name, name))
        try:
            tree[name] = _nothing(kind, defaults) if value is None else _given(kind, value)
        except (AttributeError, TypeError, struct.error) as error:
            raise DefinitionError(f"{record.name}: {name} has a default that does not fit: {value!r:.40}") from error
    return tree


def _nothing(kind: Type, defaults: Defaults) -> object:
    if isinstance(kind, Number):
        return 0
    if isinstance(kind, Text):
        return (Wide.FOUR, b"") if kind.wide else memoryview(b"")
    if isinstance(kind, Record):
        return _default(kind, defaults)
    if isinstance(kind.item, Number):
        return memoryview(bytes(kind.item.size * (kind.count if isinstance(kind, Array) else 0)))
    return [_nothing(kind.item, defaults) for _ in range(kind.count)] if isinstance(kind, Array) else []


def _given(kind: Type, value: Default) -> object:
    """Return a default in the form of ``_LEAVES``; raises ``TypeError`` and others if it is none of this type."""
    if isinstance(kind, Array | Sequence):
        if not isinstance(value, list):
            raise TypeError("no list")
        if isinstance(kind.item, Number):
            return memoryview(b"".join(_bytes(kind.item, each) for each in value))
        return [_given(kind.item, each) for each in value]
    if isinstance(kind, Number) and not isinstance(value, list):
        return int.from_bytes(_bytes(kind, value), "little", signed=kind.code in _SIGNED)
    if isinstance(kind, Text) and isinstance(value, str):
        return (Wide.FOUR, value.encode("utf-32-le")) if kind.wide else memoryview(value.encode())
    raise TypeError("another type")


def _bytes(kind: Number, value: object) -> bytes:
    return struct.pack("<" + kind.code, value)
