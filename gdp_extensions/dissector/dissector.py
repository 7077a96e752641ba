"""Wireshark dissector, generated from the Scapy layers.

I/O: it reads the Lua part that lies next to this module. The tables of fields, kinds, flags and limits come from
``layers.py``, so a change of a layer changes the dissector. A field of a form that has no display here is an error of
the generator, not a field that is left out. Source: Wireshark Developer's Guide, chapter 11 (Lua API).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.resources import files
from typing import Final

from scapy.fields import (
    ByteEnumField,
    ByteField,
    Field,
    FlagsField,
    IntField,
    LongField,
    ShortField,
    ThreeBytesField,
    XByteField,
    XLongField,
    XShortField,
    XStrFixedLenField,
)
from scapy.packet import Packet

from gdp.errors import LocalError
from gdp.frame.codec import ETHERTYPE, HEADER_BYTES, HOPS_MASK, SECOND_PATH, VERSION, Kind
from gdp.frame.diagnostic import SHOWN_BYTES
from gdp.frame.layers import (
    GDP,
    KIND_NAMES,
    PAYLOADS,
    STATEMENTS,
    CborBytesField,
    HopsField,
    NameField,
    RestField,
    Statement,
    least_bytes,
)
from gdp.limits import CBOR_DEPTH_MAX, CONTROL_MAX_BYTES, PARTS_MAX
from gdp_extensions.dissector.opened import BODIES, OpenedFrame

FIRST_LINE: Final = "-- Wireshark dissector of the Global Data Plane"
_TEMPLATE: Final = "gdp.lua"
_MARK: Final = "@tables@"
_UINTS: Final = (
    (ByteField, "uint8"), (ShortField, "uint16"), (ThreeBytesField, "uint24"), (IntField, "uint32"),
    (LongField, "uint64"),
)  # fmt: skip
_HEX: Final = (XByteField, XShortField, XLongField)


def dissector() -> str:
    """Return the text of the Lua plugin. Raises ``LocalError``: a layer has a field without a form in Wireshark."""
    layers = list(dict.fromkeys(layer for pair in PAYLOADS.values() for layer in pair))
    places = {layer: at for at, layer in enumerate(layers, 1)}
    constants = {
        "ETHERTYPE": ETHERTYPE,
        "VERSION": VERSION,
        "HEADER_BYTES": HEADER_BYTES,
        "HOPS_MASK": HOPS_MASK,
        "SECOND_PATH": SECOND_PATH,
        "PARTS_MAX": PARTS_MAX,
        "CBOR_DEPTH_MAX": CBOR_DEPTH_MAX,
        "CONTROL_MAX_BYTES": CONTROL_MAX_BYTES,
        "SHOWN_BYTES": SHOWN_BYTES,
    }
    payloads = {kind: [places[layer] for layer in pair] for kind, pair in PAYLOADS.items()}
    tables = [
        *(f"local {name} = {value}" for name, value in constants.items()),
        f"local KINDS = {_table(KIND_NAMES)}",
        f"local STATEMENTS = {_table({int(kind): True for kind in sorted(STATEMENTS)})}",
        f"local HEADER = {_table(_fields(GDP))}",
        f"local STATEMENT = {_table(_fields(Statement))}",
        "local LAYERS = {",
        *(f"  {_layer(layer)}," for layer in layers),
        "}",
        f"local OPENED = {_table(_fields(OpenedFrame))}",
        "local BODIES = {",
        *(f"  [{int(kind)}] = {_layer(layer)}," for kind, layer in BODIES.items()),
        "}",
        f"local DATA = {int(Kind.DATA)}",
        f"local PAYLOADS = {_table({int(kind): pair for kind, pair in payloads.items()})}",
    ]
    template = files(__package__).joinpath(_TEMPLATE).read_text(encoding="utf-8")
    return template.replace(_MARK, "\n".join(tables))


def prefix_of(layer: type[Packet]) -> str:
    """Return the word between ``gdp.`` and a field's name in display filters."""
    return layer.__name__.lower()


def _layer(layer: type[Packet]) -> str:
    facts = {"prefix": prefix_of(layer), "title": layer().name, "least": least_bytes(layer)}
    inside = [f"{key} = {_value(value)}" for key, value in facts.items()]
    return "{ " + ", ".join([*inside, *map(_value, _fields(layer))]) + " }"


def _fields(layer: type[Packet]) -> list[dict[str, object]]:
    return [_field(field) for field in layer.fields_desc]


def _field(field: object) -> dict[str, object]:
    """Return what the Lua part needs of a field."""
    if not isinstance(field, Field):
        raise LocalError(f"{type(field).__name__} has no form in Wireshark")
    facts: dict[str, object] = {"name": field.name, "label": field.name.replace("_", " ")}
    if isinstance(field, RestField):
        return {**facts, "type": "rest"}
    if isinstance(field, CborBytesField):
        return {**facts, "type": "cbor"}
    if isinstance(field, XStrFixedLenField):
        size = field.length_from(Packet())
        return {**facts, "type": "name" if isinstance(field, NameField) else "bytes", "size": size}
    if isinstance(field, FlagsField) and field.sz == 1:
        return {**facts, "type": "uint8", "size": 1, "hex": True, "flags": list(field.names)}
    if isinstance(field, ByteEnumField):
        return {**facts, "type": "uint8", "size": 1, "hex": True, "values": dict(field.i2s or {})}
    if isinstance(field, HopsField):
        return {**facts, "type": "uint8", "size": 1, "hops": True}
    for kind, lua in _UINTS:
        if isinstance(field, kind):
            hexadecimal = {"hex": True} if isinstance(field, _HEX) else {}
            return {**facts, "type": lua, "size": int(field.sz), **hexadecimal}
    raise LocalError(f"the field {field.name} ({type(field).__name__}) has no form in Wireshark")


def _table(value: Mapping[int, object] | Iterable[object]) -> str:
    return _value(dict(value) if isinstance(value, Mapping) else list(value))


def _value(value: object) -> str:
    """Return a value as a Lua expression."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, dict):
        pairs = ((f"[{key}]" if isinstance(key, int) else str(key), _value(each)) for key, each in value.items())
        return "{ " + ", ".join(f"{key} = {each}" for key, each in pairs) + " }"
    if isinstance(value, list | tuple):
        return "{ " + ", ".join(map(_value, value)) + " }"
    raise LocalError(f"{type(value).__name__} has no form in Lua")
