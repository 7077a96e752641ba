"""A message type as a tree of five nouns, read from the definition text that travels with a channel.

Place: pure. rosbags parses the text (ROS 1 and ROS 2 ``msg``, ROS 2 ``idl``); nothing is generated and nothing is
executed, since a definition may come from a peer.
Source: the ROS 2 interface definition article; ROS 1 ``msg`` wiki page.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

from gdp.errors import LocalError

__all__ = [
    "Array",
    "DefinitionError",
    "Number",
    "Record",
    "Sequence",
    "Text",
    "Type",
    "UnparsedError",
    "msg_name",
    "parse",
    "parsed",
]

_DEPTH_MAX: Final = 32  # records within records
_FIELDS_MAX: Final = 4_096  # of a type with all that it contains: each record as often as it stands somewhere
_RULE: Final = "=" * 80 + "\n"


class DefinitionError(LocalError):
    """There is no definition, or it describes what this program has no form for."""


class UnparsedError(DefinitionError):
    """A definition text cannot be read."""


@dataclass(frozen=True, slots=True)
class Number:
    """A number or bool. ``code``: the ``struct`` letter; ``octet``: arrays of it are bytes, not lists of numbers."""

    code: str
    octet: bool = False

    @property
    def size(self) -> int:
        """Bytes of one, which is its alignment in CDR too."""
        return SIZES[self.code]


@dataclass(frozen=True, slots=True)
class Text:
    """A string, or with ``wide`` a string of UTF-16 code units. Bounds do not change the bytes and are not kept."""

    wide: bool = False


@dataclass(frozen=True, slots=True)
class Array:
    """Exactly ``count`` items."""

    item: Number | Text | Record
    count: int


@dataclass(frozen=True, slots=True)
class Sequence:
    """A count and that many items."""

    item: Number | Text | Record


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Named fields in wire order. Records are compared by identity: one parse makes one of each type."""

    name: str
    fields: tuple[tuple[str, Type], ...]


Type: TypeAlias = Number | Text | Array | Sequence | Record

SIZES: Final = {"?": 1, "b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "Q": 8, "f": 4, "d": 8}

_NUMBERS: Final = {
    "bool": Number("?"),
    "byte": Number("B", octet=True),
    "char": Number("B", octet=True),
    "uint8": Number("B", octet=True),
    "int8": Number("b"),
    "int16": Number("h"),
    "uint16": Number("H"),
    "int32": Number("i"),
    "uint32": Number("I"),
    "int64": Number("q"),
    "uint64": Number("Q"),
    "float32": Number("f"),
    "float64": Number("d"),
}
_ROS1_BYTE: Final = Number("b", octet=True)  # in ROS 1, byte is another word for int8
_DUMMY: Final = ("structure_needs_at_least_one_member", Number("B"))  # rosidl: no CDR structure is empty

# Types that definitions use without bringing them.
_BUILTIN: Final[dict[int, dict[str, tuple[tuple[str, Type], ...]]]] = {
    1: {
        "builtin_interfaces/msg/Time": (("sec", Number("I")), ("nanosec", Number("I"))),
        "builtin_interfaces/msg/Duration": (("sec", Number("i")), ("nanosec", Number("i"))),
    },
    2: {
        "builtin_interfaces/msg/Time": (("sec", Number("i")), ("nanosec", Number("I"))),
        "builtin_interfaces/msg/Duration": (("sec", Number("i")), ("nanosec", Number("I"))),
    },
}


@lru_cache(maxsize=1024)
def parse(type_name: str, definition: str, definition_format: str, ros: int) -> Record:
    """Return the type as a tree.

    Args:
        type_name: as ROS 2 writes it, such as ``sensor_msgs/msg/Image``.
        definition: the full text, every used type after a rule of 80 ``=``.
        definition_format: ``msg`` or ``idl``; empty means that there is no definition.
        ros: 1 or 2.

    Raises:
        UnparsedError: the text cannot be read.
        DefinitionError: no definition, a used type that it lacks, a type within itself, or a field of a kind that has
            no form here (``wchar``, ``long double``, fixed point).
    """
    types = parsed(type_name, definition, definition_format)
    return _Builder(types, ros).record(msg_name(type_name, definition_format), 0)


def msg_name(type_name: str, definition_format: str) -> str:
    """Return the name under which a type stands in its parsed definition: ``msg`` text knows no services or actions."""
    if definition_format != "msg":
        return type_name
    package, _, name = type_name.partition("/")
    return f"{package}/msg/{name.rpartition('/')[2]}"


def parsed(type_name: str, definition: str, definition_format: str) -> Typesdict:
    """Return constants and fields of the types in a definition.

    Raises:
        DefinitionError: there is none.
        UnparsedError: the text cannot be read.
    """
    if definition_format not in ("msg", "idl"):
        raise DefinitionError(f"{type_name}: no definition")
    text = definition.replace("\r\n", "\n")
    try:
        if definition_format == "msg":
            return get_types_from_msg(_plain_wide(text), msg_name(type_name, "msg"))
        if not text.startswith(f"{_RULE}IDL: "):
            return get_types_from_idl(text)
        types: Typesdict = {}
        for section in text.split(_RULE)[1:]:
            types.update(get_types_from_idl(section.partition("\n")[2]))
        return types
    except (TypesysError, RecursionError, ValueError, KeyError, AssertionError) as error:
        raise UnparsedError(f"{type_name}: the definition cannot be parsed: {_first_line(error)}") from error


def _plain_wide(text: str) -> str:
    """Drop the bounds of wide strings and their constants, which rosbags' ``msg`` grammar does not know."""
    text = re.sub(r"(?m)^[ \t]*wstring(<=\d+)?[ \t]+[A-Z]\w*[ \t]*=.*$", "", text)
    return re.sub(r"(?m)^([ \t]*wstring)<=\d+", r"\1", text)


def _first_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 160 else f"{text[:160]} ..."


class _Builder:
    """Resolves names; remembers records, so that a type used twice is built once."""

    def __init__(self, types: Typesdict, ros: int) -> None:
        self._types = types
        self._ros = ros
        self._done: dict[str, Record] = {}
        self._open: set[str] = set()
        self._counts: dict[str, int] = {}  # of fields, with those of contained records

    def record(self, name: str, depth: int) -> Record:
        if name in self._done:
            return self._done[name]
        if name in self._open or depth > _DEPTH_MAX:
            raise DefinitionError(f"{name}: nested in itself or too deep")
        self._open.add(name)
        fields: tuple[tuple[str, Type], ...]
        if name in self._types:
            fields = tuple((field, self._type(name, desc, depth)) for field, desc in self._types[name][1])
        elif name in _BUILTIN[self._ros]:
            fields = _BUILTIN[self._ros][name]
        else:
            raise DefinitionError(f"{name}: the definition does not contain it")
        if not fields and self._ros == 2:
            fields = (_DUMMY,)
        self._counts[name] = sum(self._count(kind) for _, kind in fields)
        if self._counts[name] > _FIELDS_MAX:
            raise DefinitionError(f"{name}: more than {_FIELDS_MAX} fields with those of the types in it")
        self._open.discard(name)
        self._done[name] = Record(name, fields)
        return self._done[name]

    def _count(self, kind: Type) -> int:
        item = kind.item if isinstance(kind, Array | Sequence) else kind
        return 1 + self._counts[item.name] if isinstance(item, Record) else 1

    def _type(self, owner: str, desc: FieldDesc, depth: int) -> Type:
        if desc[0] == Nodetype.ARRAY:
            return Array(self._item(owner, desc[1][0], depth), desc[1][1])
        if desc[0] == Nodetype.SEQUENCE:
            return Sequence(self._item(owner, desc[1][0], depth))
        return self._item(owner, desc, depth)

    def _item(self, owner: str, desc: FieldDesc, depth: int) -> Number | Text | Record:
        if desc[0] == Nodetype.NAME:
            if desc[1].rpartition("/")[2] == "wstring" and desc[1] not in self._types:
                return Text(wide=True)
            return self.record(desc[1], depth + 1)
        if desc[0] != Nodetype.BASE:
            raise DefinitionError(f"{owner}: an array of arrays")
        base = desc[1][0]
        if base in ("string", "wstring"):
            return Text(wide=base == "wstring")
        if base == "byte" and self._ros == 1:
            return _ROS1_BYTE
        if base not in _NUMBERS:
            raise DefinitionError(f"{owner}: a field of type {base}")
        return _NUMBERS[base]
