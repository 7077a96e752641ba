"""Empty message of a type: numbers are zero, texts and sequences have no length.

Sans-I/O. A client gets it if no answer arrives in time. A response with ``bool success`` and ``string message``, such
as those of ``std_srvs``, contains the reason instead.
Source: FogROS2-FT: "an empty response" after the timeout of a request.
"""

from __future__ import annotations

from typing import Final

from gdp.limits import MESSAGE_MAX_BYTES
from proxy.serial.channel import Channel
from proxy.serial.cost import fixed_bytes, items_of
from proxy.serial.dialect import Wide
from proxy.serial.native_dialect import NativeDialect
from proxy.serial.reader import ITEMS_MAX
from proxy.serial.schema import Array, DefinitionError, Number, Record, Text, Type, parse
from proxy.serial.serializer import Codec
from proxy.serial.service import Service

__all__ = ["NoAnswer"]

_SUCCESS: Final = ("success", Number("?"))
_MESSAGE: Final = ("message", Text())


class _Leaves(NativeDialect):
    inline_max = 0  # so that every array of numbers is written as bytes


_LEAVES: Final = _Leaves()


class NoAnswer:
    """Response of a ROS 2 service that has no answer.

    Raises:
        DefinitionError: its definition cannot be read, or its fixed arrays are too large.

    Attributes:
        says_reason: whether the response has ``success`` and ``message``.
    """

    def __init__(self, response: Channel) -> None:
        record = parse(response.type_name, response.definition, response.definition_format, response.ros)
        if fixed_bytes(record, {}) > MESSAGE_MAX_BYTES or items_of(record, {}) > ITEMS_MAX:
            raise DefinitionError(f"{response.type_name}: an empty message is too large")
        self._codec = Codec(record, response.ros, _LEAVES, None)
        self._fields = record.fields
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
        tree = {name: _nothing(kind) for name, kind in self._fields}
        if self.says_reason:
            tree["message"] = memoryview(reason.encode())
        return self._codec.to_raw(tree)


def _nothing(kind: Type) -> object:
    if isinstance(kind, Number):
        return 0
    if isinstance(kind, Text):
        return (Wide.FOUR, b"") if kind.wide else memoryview(b"")
    if isinstance(kind, Record):
        return {name: _nothing(each) for name, each in kind.fields}
    if isinstance(kind.item, Number):
        return memoryview(bytes(kind.item.size * (kind.count if isinstance(kind, Array) else 0)))
    return [_nothing(kind.item) for _ in range(kind.count)] if isinstance(kind, Array) else []
