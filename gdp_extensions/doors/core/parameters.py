"""Parameters of ROS 2 nodes for Foxglove, through the parameter services that a door may call.

Sans-I/O. A parameter's name is that of its node, a dot and its own: ``/controller.gains.p``. A node's parameters can be
read where the door may call ``/node/get_parameters`` and ``/node/list_parameters``, and set with
``/node/set_parameters``.
Source: rcl_interfaces of ROS 2 Jazzy, ``ParameterType``; the Foxglove protocol, ``parameterValues``.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Final

from gdp.errors import DropReason, RemoteError

GET: Final = ("get_parameters", "rcl_interfaces/srv/GetParameters")
LIST: Final = ("list_parameters", "rcl_interfaces/srv/ListParameters")
SET: Final = ("set_parameters", "rcl_interfaces/srv/SetParameters")

_FIELDS: Final = {  # ParameterType to the field of ParameterValue, and the type that Foxglove needs
    1: ("bool_value", ""),
    2: ("integer_value", ""),
    3: ("double_value", "float64"),
    4: ("string_value", ""),
    5: ("byte_array_value", "byte_array"),
    6: ("bool_array_value", ""),
    7: ("integer_array_value", ""),
    8: ("double_array_value", "float64_array"),
    9: ("string_array_value", ""),
}
_ARRAY: Final = {1: 6, 2: 7, 3: 8, 4: 9}
_BYTES, _DOUBLE, _INTEGER = 5, 3, 2


def node_and_name(parameter: str) -> tuple[str, str]:
    """Return node and name of ``/node.name``. Raises ``RemoteError``: another form."""
    node, dot, name = parameter.partition(".")
    if not dot or not node.startswith("/") or not name:
        raise RemoteError(DropReason.MALFORMED, f"parameter {parameter!r}: its form is /node.name"[:300])
    return node, name


def from_value(parameter: str, value: Mapping[str, object]) -> dict[str, object] | None:
    """Return Foxglove's form of a ``ParameterValue`` as JSON; None: the parameter is not set."""
    kind = value.get("type")
    if not isinstance(kind, int) or kind not in _FIELDS:
        return None
    field, type_name = _FIELDS[kind]
    return {"name": parameter, "value": value[field], **({"type": type_name} if type_name else {})}


def to_value(parameter: Mapping[str, object]) -> dict[str, object]:
    """Return the ``ParameterValue`` of Foxglove's form, as JSON.

    Raises:
        RemoteError: ROS 2 has no such parameter.
    """
    value, type_name = parameter.get("value"), parameter.get("type") or ""
    kind = _kind(value, str(type_name))
    if kind is None:
        detail = f"parameter {parameter.get('name')!r}: ROS 2 has no parameter of this value"
        raise RemoteError(DropReason.MALFORMED, detail[:300])
    if kind in (_DOUBLE, _ARRAY[_DOUBLE]):
        value = [float(each) for each in value] if isinstance(value, list) else float(str(value))
    if kind == _BYTES:
        try:
            value = list(base64.b64decode(str(value)))
        except ValueError as error:
            raise RemoteError(DropReason.MALFORMED, "a byte_array is base64 text") from error
    return {"type": kind, _FIELDS[kind][0]: value}


def _kind(value: object, type_name: str) -> int | None:
    if type_name == "byte_array" and isinstance(value, str):
        return _BYTES
    if isinstance(value, list):
        return _array_kind(value, type_name)
    if isinstance(value, bool):
        return 1
    if isinstance(value, int):
        return _DOUBLE if type_name == "float64" else _INTEGER
    if isinstance(value, float):
        return _DOUBLE
    return 4 if isinstance(value, str) else None


def _array_kind(values: Sequence[object], type_name: str) -> int | None:
    kinds = {_kind(each, "") for each in values}
    if kinds <= {_INTEGER, _DOUBLE} and (type_name == "float64_array" or _DOUBLE in kinds):
        return _ARRAY[_DOUBLE]
    if len(kinds) != 1:
        return None if kinds else _ARRAY[4]
    return _ARRAY.get(kinds.pop() or 0)
