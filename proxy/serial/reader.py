"""Reader from bytes to a tree of values: a message type compiled once into steps that traverse its wire form.

Sans-I/O. A step takes the body, a position and the tree so far, and returns the position after it. Adjacent numbers, in
nested records too, are unpacked in one call.
Errors: bytes that do not fit the type raise ``MisfitError`` or ``struct.error``. The values of a message, in nested and
fixed arrays too, are counted against one budget before they are created. A reader holds that budget, so it must be used
by one thread only.
"""

from __future__ import annotations

import array
import struct
from collections.abc import Callable
from typing import Final, TypeAlias

from proxy.serial.cost import fixed_bytes, items_of
from proxy.serial.dialect import Dialect, MisfitError, Wide
from proxy.serial.layout import Wire, inline_codes, runs
from proxy.serial.schema import Array, Number, Record, Text, Type

Tree: TypeAlias = dict[str, object]
Reader: TypeAlias = "Callable[[memoryview, int], tuple[object, int]]"
_Step: TypeAlias = "Callable[[memoryview, int, Tree], int]"
_Values: TypeAlias = "tuple[object, ...] | list[object]"
_Shape: TypeAlias = "Callable[[_Values, Tree], None]"

ITEMS_MAX: Final = 1 << 19  # records, lists and texts of one message: some 150 MB
_UNSIGNED: Final = {2: "H", 4: "I", 8: "Q"}  # by bytes
_ITEMS_FREE: Final = 256  # ... of which any message may have this many
_ITEMS_PER_BYTE: Final = 4  # ... and this many for each of its bytes


def read_with(record: Record, wire: Wire, dialect: Dialect, layout: Wide = Wide.FOUR) -> Reader:
    """Return the compiled reader of a record: (body, position) to (tree, position after it)."""
    return _Compiler(wire, dialect, layout).message(record)


class _Compiler:
    def __init__(self, wire: Wire, dialect: Dialect, layout: Wide) -> None:
        self._wire = wire
        self._dialect = dialect
        self._layout = layout
        self._inline: dict[int, str | None] = {}
        self._records: dict[int, Reader] = {}
        self._count = struct.Struct(wire.order + "I").unpack_from
        self._items_known: dict[int, int] = {}
        self._bytes_known: dict[int, int] = {}
        self._items_left = [0]  # of the present message

    def message(self, record: Record) -> Reader:
        """Return the reader of a whole message."""
        read_record, left = self.record(record), self._items_left
        fixed = items_of(record, self._items_known)

        def read(body: memoryview, at: int) -> tuple[object, int]:
            left[0] = min(ITEMS_MAX, _ITEMS_FREE + _ITEMS_PER_BYTE * len(body)) - fixed
            if left[0] < 0:
                raise MisfitError("more values than such a message may have")
            return read_record(body, at)

        return read

    def record(self, record: Record) -> Reader:
        if id(record) not in self._records:
            self._records[id(record)] = self._record(record)
        return self._records[id(record)]

    def _record(self, record: Record) -> Reader:
        steps = tuple(self._steps(record))
        if len(steps) == 1:
            only = steps[0]

            def read_one(body: memoryview, at: int) -> tuple[object, int]:
                tree: Tree = {}
                at = only(body, at, tree)
                return tree, at

            return read_one

        def read(body: memoryview, at: int) -> tuple[object, int]:
            tree: Tree = {}
            for step in steps:
                at = step(body, at, tree)
            return tree, at

        return read

    def _steps(self, record: Record) -> list[_Step]:
        return [
            self._run(fields) if is_run else _named(fields[0][0], self._value(fields[0][1]))
            for fields, is_run in runs(record, lambda kind: inline_codes(kind, self._dialect.inline_max, self._inline))
        ]

    def _codes(self, kind: Type) -> str:
        return inline_codes(kind, self._dialect.inline_max, self._inline) or ""

    def _run(self, fields: list[tuple[str, Type]]) -> _Step:
        dialect = self._dialect
        codes = "".join(self._codes(kind) for _, kind in fields)
        shape = self._shape(fields)
        structs = self._wire.structs(codes, as_bits=dialect.as_bits)
        if dialect.as_bits:

            def fill_bits(body: memoryview, at: int, tree: Tree) -> int:
                packed = structs[at & 7]
                shape(packed.unpack_from(body, at), tree)
                return at + packed.size

            return fill_bits

        bits = self._wire.structs(codes, as_bits=True)
        plain, number = dialect.plain, dialect.number
        guarded = any(code in dialect.guarded for code in codes)

        def fill(body: memoryview, at: int, tree: Tree) -> int:
            packed = structs[at & 7]
            values = packed.unpack_from(body, at)
            if not guarded and plain(values):
                shape(values, tree)
            else:
                patterns = bits[at & 7].unpack_from(body, at)
                shape([number(*one) for one in zip(codes, values, patterns, strict=True)], tree)
            return at + packed.size

        return fill

    def _shape(self, fields: list[tuple[str, Type]]) -> _Shape:
        """Return the function that maps a run's flat values to their names."""
        if all(isinstance(kind, Number) for _, kind in fields):
            names = tuple(name for name, _ in fields)

            def put_all(values: _Values, tree: Tree) -> None:
                tree.update(zip(names, values, strict=True))

            return put_all
        parts: list[tuple[str, int, int | None, _Shape | None]] = []  # start, stop, shape; stop None: a single number
        at = 0
        for name, kind in fields:
            if isinstance(kind, Number):
                parts.append((name, at, None, None))
                at += 1
                continue
            width = len(self._codes(kind))
            nested = self._shape(list(kind.fields)) if isinstance(kind, Record) else None
            parts.append((name, at, at + width, nested))
            at += width

        def put(values: _Values, tree: Tree) -> None:
            for name, start, stop, nested in parts:
                if nested is not None:
                    child: Tree = {}
                    nested(values[start:stop], child)
                    tree[name] = child
                elif stop is not None:
                    tree[name] = values[start:stop]
                else:
                    tree[name] = values[start]

        return put

    def _value(self, kind: Type) -> Reader:
        if isinstance(kind, Record):
            return self.record(kind)
        if isinstance(kind, Text):
            return self._wide() if kind.wide else self._text()
        if isinstance(kind, Number):
            return self._lone(kind)
        if isinstance(kind.item, Number):
            return self._numbers(kind.item, kind.count if isinstance(kind, Array) else None)
        return self._items(self._value(kind.item), kind.item, kind.count if isinstance(kind, Array) else None)

    def _lone(self, kind: Number) -> Reader:
        step = self._run([("", kind)])

        def read(body: memoryview, at: int) -> tuple[object, int]:
            tree: Tree = {}
            at = step(body, at, tree)
            return tree[""], at

        return read

    def _text(self) -> Reader:
        cdr, count, text = self._wire.cdr, self._count, self._dialect.text

        def read(body: memoryview, at: int) -> tuple[object, int]:
            if cdr:
                at = (at + 3) & -4
            (size,) = count(body, at)
            at += 4
            end = at + size
            if end > len(body):
                raise MisfitError("a string that ends after the message")
            stop = end - 1 if cdr and size and not body[end - 1] else end
            return text(body[at:stop]), end

        return read

    def _wide(self) -> Reader:
        cdr, count, wide, layout = self._wire.cdr, self._count, self._dialect.wide, self._layout
        swap = self._wire.order == ">"
        unit = 4 if layout is Wide.FOUR else 2

        def read(body: memoryview, at: int) -> tuple[object, int]:
            if cdr:
                at = (at + 3) & -4
            (size,) = count(body, at)
            at += 4
            size *= 1 if layout is Wide.TWO_BYTES else unit
            end = at + size
            if end > len(body) or size % unit:
                raise MisfitError("a wide string that ends after the message")
            units = _swapped(body[at:end], unit) if swap else bytes(body[at:end])
            if unit == 4 and any(units[3::4]) | any(value > 0x10 for value in units[2::4]):
                raise MisfitError("a wide string with units beyond Unicode")
            return wide(units, layout), end

        return read

    def _numbers(self, item: Number, fixed: int | None) -> Reader:
        cdr, count, array = self._wire.cdr, self._count, self._dialect.array
        width = item.size
        swap = self._wire.order == ">" and width > 1

        def read(body: memoryview, at: int) -> tuple[object, int]:
            if fixed is None:
                if cdr:
                    at = (at + 3) & -4
                (number,) = count(body, at)
                at += 4
            else:
                number = fixed
            if cdr and number:
                at = (at + width - 1) & -width
            end = at + number * width
            if end > len(body):
                raise MisfitError("an array that ends after the message")
            raw = body[at:end]
            return array(item, memoryview(_swapped(raw, width)) if swap else raw), end

        return read

    def _items(self, read_item: Reader, item: Text | Record, fixed: int | None) -> Reader:
        cdr, count, left = self._wire.cdr, self._count, self._items_left
        each = items_of(item, self._items_known)
        least = fixed_bytes(item, self._bytes_known)

        def read(body: memoryview, at: int) -> tuple[object, int]:
            if fixed is None:
                if cdr:
                    at = (at + 3) & -4
                (number,) = count(body, at)
                at += 4
            else:
                number = fixed
            if number * least > len(body) - at:
                raise MisfitError("more items than the message can hold")
            if fixed is None:  # a fixed array was counted with its container
                left[0] -= number * each
                if left[0] < 0:
                    raise MisfitError("more values than such a message may have")
            items: list[object] = []
            for _ in range(number):
                value, at = read_item(body, at)
                items.append(value)
            return items, at

        return read


def _named(name: str, read: Reader) -> _Step:
    def fill(body: memoryview, at: int, tree: Tree) -> int:
        tree[name], at = read(body, at)
        return at

    return fill


def _swapped(raw: memoryview, width: int) -> bytes:
    values = array.array(_UNSIGNED[width])
    values.frombytes(raw)
    values.byteswap()
    return values.tobytes()
