"""Schema of a message type as a tree of five node kinds, parsed from the definition text of a channel.

Sans-I/O. A definition may come from a peer. Its text is bounded and parsed in time proportional to its length
(``msg_text``, ``idl_text``), and nothing is generated or executed. Types are cached by the hash of their definition.
Source: the ROS 2 interface definition article; ROS 1 ``msg`` wiki page.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, TypeAlias

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict

from gdp.errors import LocalError
from proxy.serial.bounded_cache import BoundedCache, digest_of
from proxy.serial.idl_text import parse_idl
from proxy.serial.msg_text import Default, defaults_of, parse_msg

DEFINITION_MAX_BYTES: Final = 64 << 10  # of a text in UTF-8; it is parsed in the loop that must also send hellos
_KEPT_MAX: Final = 256  # parsed definitions
_DEPTH_MAX: Final = 32  # records within records
_FIELDS_MAX: Final = 4_096  # of a type with all nested ones: each record counts as often as it occurs
_RULE: Final = "=" * 80 + "\n"
_ODD_BLANKS: Final = re.compile(r"[^\S\n\t ]")  # such as a form feed; ROS takes them for blanks


class DefinitionError(LocalError):
    """The definition is missing, or describes a type without a form here."""


class UnparsedError(DefinitionError):
    """A definition text cannot be read."""


@dataclass(frozen=True, slots=True)
class Number:
    """A number or bool. ``code``: the ``struct`` letter; ``octet``: arrays of it are bytes, not lists of numbers."""

    code: str
    octet: bool = False

    @property
    def size(self) -> int:
        """Return the bytes of one number, which is its alignment in CDR too."""
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
    """Named fields in wire order. Records are compared by identity: one parse creates one of each type."""

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
_ROS1_BYTE: Final = Number("b", octet=True)  # in ROS 1, byte is a synonym of int8
_DUMMY: Final = ("structure_needs_at_least_one_member", Number("B"))  # rosidl: no CDR structure is empty

# Types that definitions use without including them.
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


def parse(type_name: str, definition: str, definition_format: str, ros: int) -> Record:
    """Return the type as a tree.

    Args:
        type_name: as ROS 2 writes it, such as ``sensor_msgs/msg/Image``.
        definition: the full text, every used type after a line of 80 ``=``.
        definition_format: ``msg`` or ``idl``; empty means that there is no definition.

    Raises:
        UnparsedError: the text cannot be read.
        DefinitionError: no definition, one of more than ``DEFINITION_MAX_BYTES``, a used type that it lacks, a type
            within itself, two fields of one name, or a field of a kind that has no form here (``wchar``, ``long
            double``, fixed point).
    """

    def build() -> Record:
        types = parsed(type_name, definition, definition_format)
        return _Builder(types, ros).record(msg_name(type_name, definition_format), 0)

    return _records.get(digest_of(type_name, definition, definition_format, ros), build)


def msg_name(type_name: str, definition_format: str) -> str:
    """Return a type's name in its parsed definition: ``msg`` text has no names for services or actions."""
    if definition_format != "msg":
        return type_name
    package, _, name = type_name.partition("/")
    return f"{package}/msg/{name.rpartition('/')[2]}"


def parsed(type_name: str, definition: str, definition_format: str) -> Typesdict:
    """Return constants and fields of the types in a definition.

    Raises:
        DefinitionError: there is none, or it is longer than ``DEFINITION_MAX_BYTES``.
        UnparsedError: the text cannot be read.
    """
    if definition_format not in ("msg", "idl"):
        raise DefinitionError(f"{type_name}: no definition")
    if definition_bytes(definition) > DEFINITION_MAX_BYTES:
        raise DefinitionError(f"{type_name}: a definition of more than {DEFINITION_MAX_BYTES} bytes")
    text = definition.replace("\r\n", "\n")
    try:
        if definition_format == "msg":
            return parse_msg(_ODD_BLANKS.sub(" ", text), msg_name(type_name, "msg"))
        if not text.startswith(f"{_RULE}IDL: "):
            return parse_idl(text)
        return parse_idl("".join(section.partition("\n")[2] for section in text.split(_RULE)[1:]))
    except ValueError as error:
        raise UnparsedError(f"{type_name}: the definition cannot be parsed: {_first_line(error)}") from error


def default_values(type_name: str, definition: str, definition_format: str) -> dict[tuple[str, str], Default]:
    """Return the default values that a parsed ``msg`` definition states, by type and field; IDL's are not read.

    Raises:
        UnparsedError: one cannot be read.
    """
    if definition_format != "msg":
        return {}
    text = _ODD_BLANKS.sub(" ", definition.replace("\r\n", "\n"))
    try:
        return defaults_of(text, msg_name(type_name, "msg"))
    except ValueError as error:
        raise UnparsedError(f"{type_name}: a default cannot be parsed: {_first_line(error)}") from error


def definition_bytes(definition: str) -> int:
    """Return the length of a definition in UTF-8."""
    return len(definition) if definition.isascii() else len(definition.encode("utf-8", "surrogatepass"))


def _first_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 160 else f"{text[:160]} ..."


class _Builder:
    """Resolves names and caches records, so that a type used twice is built once."""

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
        if len(dict(fields)) != len(fields):
            raise DefinitionError(f"{name}: two fields of one name")
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


_records: Final = BoundedCache[Record](_KEPT_MAX, DefinitionError)
