"""The definition text and the type hash of a ROS 2 interface, from what its generated Python classes say of themselves.

Place: pure; classes are looked up by the caller and only read. Default values and constants do not show in a class's
fields and are not in the text; neither changes a message's bytes or its hash.
Source: REP-2016 (type hashes); ``SLOT_TYPES`` of rosidl_generator_py.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias, cast

from gdp.errors import LocalError

__all__ = ["Field", "Interface", "definition_of", "interface_of", "type_hash_of"]

_RULE: Final = "=" * 80
_WORDS: Final = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
_IDS: Final = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "long double": 12,
    "char": 13,
    "wchar": 14,
    "bool": 15,
    "byte": 16,
    "string": 17,
    "wstring": 18,
}
_RECORD_ID: Final = 1
_BOUNDED: Final = 4  # string 17 becomes bounded string 21, wstring 18 becomes 22
_ARRAY, _BOUNDED_SEQUENCE, _SEQUENCE = 48, 96, 144
_DUMMY: Final = "structure_needs_at_least_one_member"


@dataclass(frozen=True, slots=True)
class Field:
    """One field.

    Args:
        word: as ``msg`` files write it (``uint8``, ``string``), or the full name of a used type.
        text_max: bound of a string, 0 for none.
        shape: what a hash adds to the type's number: 0 one value, 48 an array, 96 a bounded sequence, 144 a free one.
        count: length of an array, bound of a sequence.
    """

    name: str
    word: str
    text_max: int = 0
    shape: int = 0
    count: int = 0


Interface: TypeAlias = dict[str, tuple[Field, ...]]  # the type itself first, then every type it uses


class _Slot(Protocol):
    """rosidl_parser's description of a field type; which of these it has depends on its class."""

    typename: str
    name: str
    namespaces: list[str]
    value_type: _Slot
    size: int
    maximum_size: int


class _Message(Protocol):
    SLOT_TYPES: tuple[_Slot, ...]

    @classmethod
    def get_fields_and_field_types(cls) -> Mapping[str, str]: ...


def interface_of(type_name: str, lookup: Callable[[str], type]) -> Interface:
    """Return the fields of a message, of one half of a service, or of a service, and of all that it uses.

    Args:
        type_name: such as ``sensor_msgs/msg/Image`` or ``std_srvs/srv/SetBool``.
        lookup: gives the generated class of such a name, or raises LocalError.

    Raises:
        LocalError: a class is unknown, or is not one that rosidl generated.
    """
    types: Interface = {}
    open_names = [type_name]
    while open_names:
        name = open_names.pop(0)
        if name in types:
            continue
        found = lookup(name)
        types[name] = _service_fields(name) if hasattr(found, "Request") else _message_fields(name, found)
        open_names += [field.word for field in types[name] if "/" in field.word]
    return types


def definition_of(interface: Interface) -> str:
    """Return the ``msg`` text: the fields of the type, then each used type after a rule of 80 ``=``."""
    first, *used = interface
    return _body(interface[first]) + "".join(f"{_RULE}\nMSG: {_short(name)}\n{_body(interface[name])}" for name in used)


def type_hash_of(interface: Interface) -> str:
    """Return the type hash, ``RIHS01_`` and 64 hex digits."""
    first, *used = interface
    described = {
        "type_description": _struct(first, interface[first]),
        "referenced_type_descriptions": [_struct(name, interface[name]) for name in sorted(used)],
    }
    return f"RIHS01_{hashlib.sha256(json.dumps(described).encode()).hexdigest()}"


def _service_fields(name: str) -> tuple[Field, ...]:
    parts = ("request", "response", "event")
    return tuple(Field(f"{part}_message", f"{name}_{part.capitalize()}") for part in parts)


def _message_fields(name: str, found: type) -> tuple[Field, ...]:
    if not hasattr(found, "SLOT_TYPES"):
        raise LocalError(f"{name}: its Python class does not say what its fields are")
    message = cast("_Message", found)
    fields = zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True)
    return tuple(_field(field, slot) for field, slot in fields)


def _field(name: str, slot: _Slot) -> Field:
    kind = type(slot).__name__
    if kind == "Array":
        return _of(name, slot.value_type, _ARRAY, slot.size)
    if kind == "BoundedSequence":
        return _of(name, slot.value_type, _BOUNDED_SEQUENCE, slot.maximum_size)
    if kind == "UnboundedSequence":
        return _of(name, slot.value_type, _SEQUENCE, 0)
    return _of(name, slot, 0, 0)


def _of(name: str, slot: _Slot, shape: int, count: int) -> Field:
    kind = type(slot).__name__
    if kind == "BasicType":
        return Field(name, _WORDS.get(slot.typename, slot.typename), 0, shape, count)
    if kind == "NamespacedType":
        return Field(name, "/".join([*slot.namespaces, slot.name]), 0, shape, count)
    text_max = slot.maximum_size if kind.startswith("Bounded") else 0
    return Field(name, "wstring" if kind.endswith("WString") else "string", text_max, shape, count)


def _body(fields: tuple[Field, ...]) -> str:
    return "".join(f"{_written(field)} {field.name}\n" for field in fields)


def _short(name: str) -> str:
    """``pkg/msg/Name`` is written ``pkg/Name``; the types of services and actions keep their full names."""
    return name.replace("/msg/", "/")


def _written(field: Field) -> str:
    word = _short(field.word) + (f"<={field.text_max}" if field.text_max else "")
    if field.shape == _ARRAY:
        return f"{word}[{field.count}]"
    return f"{word}[<={field.count}]" if field.shape == _BOUNDED_SEQUENCE else f"{word}[]" if field.shape else word


def _struct(name: str, fields: tuple[Field, ...]) -> dict[str, object]:
    # rosidl gives a structure without fields one byte, for IDL has no empty ones
    shown = fields or (Field(_DUMMY, "uint8"),)
    return {"type_name": name, "fields": list(_hashed(shown))}


def _hashed(fields: tuple[Field, ...]) -> Iterator[dict[str, object]]:
    for field in fields:
        nested = "/" in field.word
        number = _RECORD_ID if nested else _IDS[field.word] + (_BOUNDED if field.text_max else 0)
        yield {
            "name": field.name,
            "type": {
                "type_id": number + field.shape,
                "capacity": field.count,
                "string_capacity": field.text_max,
                "nested_type_name": field.word if nested else "",
            },
        }
