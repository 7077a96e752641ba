"""Type translation: a type's definition in the form of the other ROS, and its hashes there.

Sans-I/O; works on the fields that rosbags parses. A type that both ROS ship and that matches takes the other ROS's own
form (upper-case field names of ``CameraInfo``, constants, bounds), so that its hash is the published one.
Source: ``genmsg.gentools`` for the md5 text; REP 2016 for RIHS01; the ROS 2 interface definition article.
"""

from __future__ import annotations

import hashlib
from functools import cache
from typing import Final, TypeAlias

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Constdefs, Fielddefs, FieldDesc, NameDesc, Typesdict
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.store import Typestore

from proxy.serial.channel import Channel, RosVersion
from proxy.serial.schema import DefinitionError, parsed

DUMMY: Final = "structure_needs_at_least_one_member"  # rosidl: no CDR structure is empty

# By type and field: longest string, most items; zero: no bound.
Bounds: TypeAlias = dict[tuple[str, str], tuple[int, int]]

_HEADER: Final = "std_msgs/msg/Header"
_CLOCKS: Final = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
_STANDARD: Final = {1: (Stores.ROS1_NOETIC,), 2: (Stores.ROS2_JAZZY, Stores.ROS2_HUMBLE)}

_Item: TypeAlias = "BaseDesc | NameDesc"
_Shape: TypeAlias = tuple[tuple[str, FieldDesc], ...]

_store = cache(get_typestore)


def types_of(channel: Channel) -> Typesdict:
    """Return the constants and fields of every type in a channel's definition.

    Raises:
        DefinitionError: there is none, or it cannot be read.
    """
    return parsed(channel.type_name, channel.definition, channel.definition_format)


def bounds_of(types: Typesdict) -> Bounds:
    """Return the bounds of strings and sequences; those of wide strings are not known."""
    bounds: Bounds = {}
    for name, (_, fields) in types.items():
        for field, desc in fields:
            item = desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc
            text = item[1][1] if item[0] == Nodetype.BASE else 0
            count = desc[1][1] if desc[0] == Nodetype.SEQUENCE else 0
            if text or count:
                bounds[name, field] = (int(text), int(count))
    return bounds


def retyped(types: Typesdict, ros: RosVersion) -> Typesdict:
    """Return the other ROS's types in the form of ROS ``ros``, under the same names."""
    twins: Typesdict = {}
    if ros == 2:
        twins.update({name: _store(Stores.ROS2_JAZZY).fielddefs[name] for name in _CLOCKS})
    for name, (constants, fields) in types.items():
        shape = _shape(name, fields)
        standard = next((known for store in _STANDARD[ros] if (known := _known(store, name, shape))), None)
        if standard is not None and ros == 1:
            twins[name] = standard  # unchanged: md5 sums distinguish char from uint8
            continue
        if standard is not None:
            twins[name] = (standard[0], [(field, _plain(desc, bounded=True)) for field, desc in standard[1]])
            continue
        if len({field for field, _ in shape}) != len(shape):
            raise DefinitionError(f"{name}: fields that differ in upper and lower case alone")
        own = [(field, _plain(desc, bounded=False)) for field, desc in fields if field != DUMMY]
        twins[name] = (constants, list(shape) if ros == 2 else own)
    return twins


def _known(store: Stores, name: str, shape: _Shape) -> tuple[Constdefs, Fielddefs] | None:
    known = _store(store).fielddefs.get(name)
    return known if known is not None and _shape(name, known[1]) == shape else None


def _shape(name: str, fields: Fielddefs) -> _Shape:
    """Return fields in a form common to both ROS: no bounds, no ``seq`` of a header, no dummy, lower case."""
    unsaid = (DUMMY, "seq") if name == _HEADER else (DUMMY,)
    return tuple((field.lower(), _plain(desc, bounded=False)) for field, desc in fields if field not in unsaid)


def _plain(desc: FieldDesc, *, bounded: bool) -> FieldDesc:
    if desc[0] == Nodetype.ARRAY:
        return (Nodetype.ARRAY, (_plain_item(desc[1][0], bounded=bounded), desc[1][1]))
    if desc[0] == Nodetype.SEQUENCE:
        return (Nodetype.SEQUENCE, (_plain_item(desc[1][0], bounded=bounded), desc[1][1] if bounded else 0))
    return _plain_item(desc, bounded=bounded)


def _plain_item(desc: _Item, *, bounded: bool) -> _Item:
    if desc[0] == Nodetype.NAME:
        return desc
    base, bound = desc[1]  # char is a synonym of uint8 in both ROS
    return (Nodetype.BASE, ("uint8" if base == "char" else base, bound if bounded else 0))


def text_of(name: str, types: Typesdict, ros: RosVersion) -> str:
    """Return the full definition text of a type, every used type after a line of 80 ``=``.

    Raises:
        DefinitionError: a used type is a part of an action, which has no name in a ``msg`` text.
    """
    try:
        return _filled(types).generate_msgdef(name, ros)[0]
    except (TypesysError, AssertionError, RecursionError) as error:
        raise DefinitionError(f"{name}: no definition text for ROS {ros}") from error


def rihs01(name: str, types: Typesdict) -> str:
    """Return the ROS 2 type hash; empty where a type within has none."""
    try:
        return _filled(types).hash_rihs01(name)
    except (KeyError, RecursionError):
        return ""


def _filled(types: Typesdict) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    store.fielddefs.update(types)
    return store


def md5_text(name: str, types: Typesdict) -> str:
    """Return the text from which ROS 1 computes the md5 sum."""
    return _md5_text(name, types, {})


def _md5_text(name: str, types: Typesdict, done: dict[str, str]) -> str:
    constants, fields = types[name]
    lines = [f"{kind} {constant}={value}" for constant, kind, value in constants]
    for field, desc in fields:
        if field == DUMMY:
            continue
        item, brackets = _item_of(desc)
        if item[0] == Nodetype.BASE:
            word = f"{item[1][0]}{brackets}"
        elif item[1] in _CLOCKS:
            word = f"{_CLOCKS[item[1]]}{brackets}"
        else:
            if item[1] not in done:
                nested = _md5_text(item[1], types, done)
                done[item[1]] = hashlib.md5(nested.encode(), usedforsecurity=False).hexdigest()
            word = done[item[1]]
        lines.append(f"{word} {field}")
    return "\n".join(lines)


def _item_of(desc: FieldDesc) -> tuple[_Item, str]:
    if desc[0] == Nodetype.ARRAY:
        return desc[1][0], f"[{desc[1][1]}]"
    if desc[0] == Nodetype.SEQUENCE:
        return desc[1][0], "[]"
    return desc, ""
