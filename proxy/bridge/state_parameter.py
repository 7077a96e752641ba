"""State parameter: the byte array ``state`` of a node, read and written by the services that every ROS 2 node has.

Sans-I/O.
Source: rcl_interfaces 2.0 (``GetParameters``, ``SetParameters``). Requests are written with rosbags' types. Of
responses only the beginning is read, because vendors pad the ends differently.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

GET: Final = ("get_parameters", "rcl_interfaces/srv/GetParameters")
SET: Final = ("set_parameters", "rcl_interfaces/srv/SetParameters")
_NAME: Final = "state"
_BYTES: Final = 5  # ParameterType.PARAMETER_BYTE_ARRAY
_VALUE: Final = struct.Struct("<IB")  # number of values, and type of the first
_TEXT_AT: Final = 24  # after a bool, an integer and a double
_LENGTH: Final = struct.Struct("<I")
_RESULT: Final = struct.Struct("<I?3xI")  # number of results, success of the first, length of its reason
_TYPES: Final = {
    "rcl_interfaces/msg/GetParameters_Request": "string[] names",
    "rcl_interfaces/msg/SetParameters_Request": "rcl_interfaces/Parameter[] parameters",
}


@cache
def _store() -> Typestore:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _TYPES.items():
        store.register(get_types_from_msg(text, name))
    return store


def read_request() -> bytes:
    """Return the request that reads the state, as CDR."""
    store, name = _store(), "rcl_interfaces/msg/GetParameters_Request"
    return bytes(store.serialize_cdr(store.types[name](names=[_NAME]), name))


def state_in(raw: bytes) -> bytes | None:
    """Return the state in a response to ``read_request``; None: the parameter is missing or has another type."""
    body = memoryview(raw)[4:]
    try:
        count, kind = _VALUE.unpack_from(body)
        (text_bytes,) = _LENGTH.unpack_from(body, _TEXT_AT)
        at = (_TEXT_AT + _LENGTH.size + text_bytes + 3) // 4 * 4
        (size,) = _LENGTH.unpack_from(body, at)
    except struct.error:
        return None
    state = bytes(body[at + _LENGTH.size :][:size])
    return state if (count, kind, len(state)) == (1, _BYTES, size) else None


def write_request(state: bytes) -> bytes:
    """Return the request that writes the state, as CDR."""
    import numpy as np  # most servers export no state

    store = _store()
    none = {"integer_array_value": np.zeros(0, np.int64), "double_array_value": np.zeros(0, np.float64)}
    value = store.types["rcl_interfaces/msg/ParameterValue"](
        type=_BYTES,
        bool_value=False,
        integer_value=0,
        double_value=0.0,
        string_value="",
        byte_array_value=np.frombuffer(state, np.uint8),
        bool_array_value=np.zeros(0, np.bool_),
        string_array_value=[],
        **none,
    )
    parameter = store.types["rcl_interfaces/msg/Parameter"](name=_NAME, value=value)
    name = "rcl_interfaces/msg/SetParameters_Request"
    return bytes(store.serialize_cdr(store.types[name](parameters=[parameter]), name))


def was_set(raw: bytes) -> str:
    """Return why the node did not accept the state; empty: it did."""
    body = memoryview(raw)[4:]
    try:
        count, is_done, size = _RESULT.unpack_from(body)
    except struct.error:
        return "its answer cannot be read"
    if count == 1 and is_done:
        return ""
    return bytes(body[_RESULT.size :][: max(size - 1, 0)]).decode("utf-8", "replace") or "it says no"
