"""Type match: whether two types are equal field by field, and how one tree of values serves both.

Sans-I/O. All differences between ROS 1 and ROS 2 without a difference in meaning are here: ``Header.seq``, the signs in
times and durations, ``byte``, the dummy of an empty type, upper case in field names. Fields that one side lacks are
allowed where a rule says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

from proxy.serial.channel import RosVersion
from proxy.serial.dialect import MisfitError
from proxy.serial.empty import Defaults, default_tree
from proxy.serial.schema import Array, DefinitionError, Number, Record, Sequence, Text, Type
from proxy.serial.type_translation import DUMMY, Bounds

Amend: TypeAlias = "Callable[[object], None]"  # completes the tree of a value for the other side, or refuses it

_Field: TypeAlias = "tuple[str, Type]"

_WORDS: Final = {"?": "bool", "b": "int8", "B": "uint8", "h": "int16", "H": "uint16", "i": "int32", "I": "uint32"}
_WORDS64: Final = {"q": "int64", "Q": "uint64", "f": "float32", "d": "float64"}
_SEQ: Final = ("seq", Number("I"))
_HEADER: Final = ("stamp", "frame_id")  # fields of a ROS 2 header
_ROS1_CLOCKS: Final = {"builtin_interfaces/msg/Time": ("I", "I"), "builtin_interfaces/msg/Duration": ("i", "i")}
_ROS2_CLOCK: Final = (("sec", Number("i")), ("nanosec", Number("I")))


@dataclass(frozen=True, slots=True)
class Side:
    """A type on one side, with its ROS version, its bounds and its default values."""

    record: Record
    ros: RosVersion
    bounds: Bounds
    defaults: Defaults = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Types to read a message and to write its tree, and the amendment of the tree in between (None: none).

    ``differences``: the fields that one side lacks, as texts.
    """

    read: Record
    write: Record
    amend: Amend | None
    differences: tuple[str, ...] = ()


def match(source: Side, target: Side, *, is_strict: bool = True) -> Pair:
    """Return how messages of one type become those of the other. Names of types are ignored.

    Args:
        is_strict: both have the same fields in the same order; else one may lack some, and the order does not count.

    Raises:
        DefinitionError: the types differ; the text names the first differing field, there (``source``) and here.
    """
    matcher = _Matcher(source, target, is_strict=is_strict)
    return replace(matcher.record(source.record, target.record, ""), differences=tuple(matcher.differences))


class _Matcher:
    def __init__(self, source: Side, target: Side, *, is_strict: bool) -> None:
        self.differences: list[str] = []
        self._is_strict = is_strict
        self._source = source
        self._target = target
        self._crossing = source.ros != target.ros
        self._done: dict[tuple[int, int], Pair] = {}

    def record(self, there: Record, here: Record, path: str) -> Pair:
        key = (id(there), id(here))
        if key not in self._done:
            self._done[key] = self._clocks(there, here, path) or self._fields(there, here, path)
        return self._done[key]

    def _clocks(self, there: Record, here: Record, path: str) -> Pair | None:
        """Return the pair of a ROS 1 time or duration and its ROS 2 form; the writer refuses a number out of range."""
        if not self._crossing:
            return None
        ros1, ros2 = (there, here) if self._source.ros == 1 else (here, there)
        if _codes(ros1) != _ROS1_CLOCKS.get(ros1.name) or ros2.fields != _ROS2_CLOCK:
            return None
        if ros2.name in _ROS1_CLOCKS and ros2.name != ros1.name:
            raise _difference(path, there, here)
        return Pair(there, here, None)

    def _fields(self, there: Record, here: Record, path: str) -> Pair:
        unpaired = {DUMMY, "seq"} if self._crossing and _headers(there, here) else {DUMMY}
        read: list[tuple[str, Type]] = [each for each in there.fields if each[0] in unpaired]  # both are first
        write: dict[str, Type] = {name: kind for name, kind in here.fields if name in unpaired}
        filled: dict[str, object] = {name: 0 for name in write if name not in dict(read)}
        amends: list[tuple[str, Amend]] = []
        theirs = [each for each in there.fields if each[0] not in unpaired]
        ours = [each for each in here.fields if each[0] not in unpaired]
        partners = self._partners(theirs, ours, path)
        for one, other in zip(theirs, partners, strict=True):
            if other is None:
                if self._is_strict:
                    raise _difference(_join(path, one[0]), one[1], None)
                read.append(one)
                continue
            at = _join(path, other[0])
            if one[0].lower() != other[0].lower():
                raise DefinitionError(f"{at}: called {one[0]} there")
            limits = self._limits((there.name, one[0]), (here.name, other[0]))
            reading, writing, amend = self._type(one[1], other[1], at, limits)
            read.append((other[0], reading))
            write[other[0]] = writing
            if amend is not None:
                amends.append((other[0], amend))
        if missing := [each for each in ours if each[0] not in write]:
            if self._is_strict:
                raise _difference(_join(path, missing[0][0]), None, missing[0][1])
            defaults = default_tree(here, self._target.ros, self._target.defaults)
            filled |= {name: defaults[name] for name, _ in missing}
            write |= dict(missing)
        amend = _amend_record(filled, tuple(amends)) if filled or amends else None
        fields = tuple((name, write[name]) for name, _ in here.fields)
        return Pair(Record(there.name, tuple(read)), Record(here.name, fields), amend)

    def _partners(self, theirs: list[_Field], ours: list[_Field], path: str) -> list[_Field | None]:
        """Return the field here of each field there, by place or by name; None: there is none."""
        if self._is_strict:
            return [*ours[: len(theirs)], *[None] * (len(theirs) - len(ours))]
        left = {each[0].lower(): each for each in ours}
        partners = [left.pop(name.lower(), None) for name, _ in theirs]
        missing = {name for name, _ in left.values()}
        if [each for each in partners if each is not None] != [each for each in ours if each[0] not in missing]:
            self.differences.append(f"{path or 'the type'}: its fields have another order there")
        dropped = [name for (name, _), partner in zip(theirs, partners, strict=True) if partner is None]
        self.differences += [f"{_join(path, name)}: not known here, dropped" for name in dropped]
        self.differences += [f"{_join(path, name)}: not known there, has its default" for name, _ in left.values()]
        return partners

    def _limits(self, there: tuple[str, str], here: tuple[str, str]) -> tuple[int, int]:
        """Return the bounds that are tighter here than there, zero for none."""
        wide = self._source.bounds.get(there, (0, 0))
        text, count = (
            tight if tight and not 0 < loose <= tight else 0
            for loose, tight in zip(wide, self._target.bounds.get(here, (0, 0)), strict=True)
        )
        return text, count

    def _type(self, there: Type, here: Type, path: str, limits: tuple[int, int]) -> tuple[Type, Type, Amend | None]:
        if isinstance(there, Array) and isinstance(here, Array) and there.count == here.count:
            read, write, amend = self._item(there.item, here.item, f"{path}[]", limits[0])
            each = None if amend is None else _amend_items(amend)
            return Array(read, there.count), Array(write, here.count), each
        if isinstance(there, Sequence) and isinstance(here, Sequence):
            read, write, amend = self._item(there.item, here.item, f"{path}[]", limits[0])
            each = None if amend is None else _amend_items(amend)
            if limits[1]:
                each = _bound_items(path, limits[1], write.size if isinstance(write, Number) else 1, each)
            return Sequence(read), Sequence(write), each
        if isinstance(there, Array | Sequence) or isinstance(here, Array | Sequence):
            raise _difference(path, there, here)
        return self._item(there, here, path, limits[0])

    def _item(
        self, there: Number | Text | Record, here: Number | Text | Record, path: str, limit: int
    ) -> tuple[Number | Text | Record, Number | Text | Record, Amend | None]:
        if isinstance(there, Record) and isinstance(here, Record):
            pair = self.record(there, here, path)
            return pair.read, pair.write, pair.amend
        if isinstance(there, Number) and isinstance(here, Number):
            if there.code == here.code or (there.octet and here.octet):
                return here, here, None  # a byte has eight bits, whatever its sign
        elif there == here:
            return there, here, _bound_text(path, limit) if limit else None
        raise _difference(path, there, here)


def _headers(there: Record, here: Record) -> bool:
    names = [tuple(name.lower() for name, _ in record.fields) for record in (there, here)]
    if _HEADER not in names or ("seq", *_HEADER) not in names:
        return False
    return _SEQ in (there.fields[0], here.fields[0])


def _codes(record: Record) -> tuple[str, ...]:
    return tuple(kind.code if isinstance(kind, Number) else "" for _, kind in record.fields)


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _difference(path: str, there: Type | None, here: Type | None) -> DefinitionError:
    return DefinitionError(f"{path or 'the type'}: {_said(there)} there, {_said(here)} here")


def _said(kind: Type | None) -> str:
    if kind is None:
        return "nothing"
    if isinstance(kind, Number):
        return _WORDS.get(kind.code) or _WORDS64[kind.code]
    if isinstance(kind, Text):
        return "wstring" if kind.wide else "string"
    if isinstance(kind, Record):
        return kind.name
    return f"{_said(kind.item)}[{kind.count if isinstance(kind, Array) else ''}]"


def _amend_record(filled: Mapping[str, object], amends: tuple[tuple[str, Amend], ...]) -> Amend:
    def amend(tree: object) -> None:
        if not isinstance(tree, dict):
            raise MisfitError("a record is a map")
        tree.update(filled)
        for name, finish in amends:
            finish(tree[name])

    return amend


def _amend_items(finish: Amend) -> Amend:
    def amend(items: object) -> None:
        if not isinstance(items, list):
            raise MisfitError("an array is a list")
        for item in items:
            finish(item)

    return amend


def _bound_items(path: str, most: int, width: int, each: Amend | None) -> Amend:
    def amend(items: object) -> None:
        if not isinstance(items, list | memoryview):
            raise MisfitError("an array is a list or bytes")
        count = len(items) // width
        if count > most:
            raise MisfitError(f"{path}: {count} items, at most {most} here")
        if each is not None:
            each(items)

    return amend


def _bound_text(path: str, most: int) -> Amend:
    def amend(text: object) -> None:
        if not isinstance(text, memoryview):
            raise MisfitError("a text is bytes")
        if len(text) > most:
            raise MisfitError(f"{path}: a string of {len(text)} bytes, at most {most} here")

    return amend
