"""Writer from a tree of values to bytes: the inverse of ``reader``, for untrusted trees.

Sans-I/O. Writes ROS 1 or little-endian CDR with zero padding, so that equal values give equal bytes.
Errors: a tree that does not fit the type raises ``MisfitError``, ``KeyError``, ``TypeError``, ``ValueError``,
``OverflowError`` or ``struct.error``; the serializer translates them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from operator import itemgetter
from typing import Final, TypeAlias

from proxy.serial.dialect import Dialect, MisfitError, Wide
from proxy.serial.layout import Wire, inline_codes, runs
from proxy.serial.schema import Array, Number, Record, Text, Type

Writer: TypeAlias = "Callable[[bytearray, object], None]"
_Flatten: TypeAlias = "Callable[[object, list[object]], None]"

_COUNT: Final = struct.Struct("<I")
_PADS: Final = tuple(bytes(size) for size in range(8))


def write_with(record: Record, wire: Wire, dialect: Dialect) -> Writer:
    """Return the compiled writer of a record: (body so far, tree), appending."""
    return _Compiler(wire, dialect).record(record)


class _Compiler:
    def __init__(self, wire: Wire, dialect: Dialect) -> None:
        self._wire = wire
        self._dialect = dialect
        self._inline: dict[int, str | None] = {}
        self._records: dict[int, Writer] = {}

    def record(self, record: Record) -> Writer:
        if id(record) not in self._records:
            steps = tuple(self._steps(record))

            def write(body: bytearray, tree: object) -> None:
                if type(tree) is not dict:
                    raise MisfitError("a record is a map")
                for step in steps:
                    step(body, tree)

            self._records[id(record)] = write
        return self._records[id(record)]

    def _steps(self, record: Record) -> list[Writer]:
        return [
            self._run(fields) if is_run else _named(fields[0][0], self._value(fields[0][1]))
            for fields, is_run in runs(record, self._codes)
        ]

    def _codes(self, kind: Type) -> str | None:
        return inline_codes(kind, self._dialect.inline_max, self._inline)

    def _run(self, fields: list[tuple[str, Type]]) -> Writer:
        dialect = self._dialect
        codes = "".join(self._codes(kind) or "" for _, kind in fields)
        flatten = self._flatten(fields)
        structs = self._wire.structs(codes, as_bits=dialect.as_bits)
        patterns = self._wire.structs(codes, as_bits=True)
        bits = dialect.bits
        has_bools = "?" in codes

        def exactly(flat: list[object], phase: int) -> bytes:
            return patterns[phase].pack(*[bits(code, value) for code, value in zip(codes, flat, strict=True)])

        def write(body: bytearray, tree: object) -> None:
            flat: list[object] = []
            flatten(tree, flat)
            phase = len(body) & 7
            if has_bools:  # struct would accept any value for a bool
                body += exactly(flat, phase)
                return
            try:
                packed = structs[phase].pack(*flat)
            except struct.error:  # not all are plain numbers: the dialect accepts or refuses each
                packed = exactly(flat, phase)
            body += packed

        return write

    def _flatten(self, fields: list[tuple[str, Type]]) -> _Flatten:
        """Return the function that lists a run's values in wire order."""
        if len(fields) > 1 and all(isinstance(kind, Number) for _, kind in fields):
            get = itemgetter(*(name for name, _ in fields))

            def take_all(tree: object, flat: list[object]) -> None:
                if not isinstance(tree, dict):
                    raise MisfitError("a record is a map")
                flat += get(tree)

            return take_all
        parts = tuple(_part(name, kind, self._nested(kind)) for name, kind in fields)

        def take(tree: object, flat: list[object]) -> None:
            for part in parts:
                part(tree, flat)

        return take

    def _nested(self, kind: Type) -> _Flatten | None:
        return self._flatten(list(kind.fields)) if isinstance(kind, Record) else None

    def _value(self, kind: Type) -> Writer:
        if isinstance(kind, Record):
            return self.record(kind)
        if isinstance(kind, Text):
            return self._wide() if kind.wide else self._text()
        if isinstance(kind, Number):
            run = self._run([("", kind)])
            return lambda body, value: run(body, {"": value})
        if isinstance(kind.item, Number):
            return self._numbers(kind.item, kind.count if isinstance(kind, Array) else None)
        return self._items(self._value(kind.item), kind.count if isinstance(kind, Array) else None)

    def _text(self) -> Writer:
        cdr, untext = self._wire.cdr, self._dialect.untext

        def write(body: bytearray, value: object) -> None:
            raw = untext(value)
            if cdr:
                body += _PADS[-len(body) & 3]
                body += _COUNT.pack(len(raw) + 1)
                body += raw
                body.append(0)
            else:
                body += _COUNT.pack(len(raw))
                body += raw

        return write

    def _wide(self) -> Writer:
        cdr, unwide = self._wire.cdr, self._dialect.unwide

        def write(body: bytearray, value: object) -> None:
            layout, units = unwide(value)
            width = 4 if layout is Wide.FOUR else 2
            if len(units) % width:
                raise MisfitError("a wide string of a broken unit")
            if cdr:
                body += _PADS[-len(body) & 3]
            body += _COUNT.pack(len(units) if layout is Wide.TWO_BYTES else len(units) // width)
            body += units

        return write

    def _numbers(self, item: Number, fixed: int | None) -> Writer:
        cdr, unarray, width = self._wire.cdr, self._dialect.unarray, item.size

        def write(body: bytearray, value: object) -> None:
            raw = unarray(item, value)
            if fixed is None:
                if cdr:
                    body += _PADS[-len(body) & 3]
                body += _COUNT.pack(len(raw) // width)
            elif len(raw) != fixed * width:
                raise MisfitError("an array of another length")
            if cdr and raw:
                body += _PADS[-len(body) & (width - 1)]
            body += raw

        return write

    def _items(self, write_item: Writer, fixed: int | None) -> Writer:
        cdr = self._wire.cdr

        def write(body: bytearray, value: object) -> None:
            if not isinstance(value, list | tuple):
                raise MisfitError("an array is a list")
            if fixed is None:
                if cdr:
                    body += _PADS[-len(body) & 3]
                body += _COUNT.pack(len(value))
            elif len(value) != fixed:
                raise MisfitError("an array of another length")
            for item in value:
                write_item(body, item)

        return write


def _named(name: str, write: Writer) -> Writer:
    def step(body: bytearray, tree: object) -> None:
        write(body, _member(tree, name))

    return step


def _member(tree: object, name: str) -> object:
    if not isinstance(tree, dict):
        raise MisfitError("a record is a map")
    return tree[name]


def _one(name: str) -> _Flatten:
    def take(tree: object, flat: list[object]) -> None:
        flat.append(_member(tree, name))

    return take


def _part(name: str, kind: Type, nested: _Flatten | None) -> _Flatten:
    if isinstance(kind, Number):
        return _one(name)
    if nested is not None:
        inner = nested

        def take_record(tree: object, flat: list[object]) -> None:
            inner(_member(tree, name), flat)

        return take_record
    count = kind.count if isinstance(kind, Array) else 0

    def take_array(tree: object, flat: list[object]) -> None:
        values = _member(tree, name)
        if not isinstance(values, list | tuple) or len(values) != count:
            raise MisfitError("an array of another length")
        flat += values

    return take_array
