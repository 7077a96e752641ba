"""Layout of numbers on the wire: a run of fixed size is packed and unpacked in one call at any alignment.

Sans-I/O.
Source: CORBA CDR 15.3 (a primitive is aligned to its size, counted from the start of the body); ROS 1 packs tightly.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import Final

from proxy.serial.dialect import BITS
from proxy.serial.schema import SIZES, Array, Number, Record, Type

_AS_BITS: Final = str.maketrans(BITS)
# numbers of one record that are unpacked in runs; further arrays and records are unpacked one by one
_RUN_MAX: Final = 4_096
_INLINE_MAX: Final = 256  # numbers in one record that still form one run


class Phases(dict[int, struct.Struct]):
    """Structs of a run, one for each start offset modulo 8, created when first needed."""

    __slots__ = ("_cdr", "_letters", "_order")

    def __init__(self, letters: str, order: str, *, cdr: bool) -> None:
        super().__init__()
        self._letters = letters
        self._order = order
        self._cdr = cdr

    def __missing__(self, phase: int) -> struct.Struct:
        made = struct.Struct(self._order + (_padded(self._letters, phase) if self._cdr else self._letters))
        self[phase] = made
        return made


class Wire:
    """A wire form: ROS 1, or CDR (XCDR1) of either byte order.

    Args:
        cdr: aligned, strings terminated; otherwise ROS 1.
        order: ``<`` or ``>``.
    """

    __slots__ = ("cdr", "order")

    def __init__(self, *, cdr: bool, order: str = "<") -> None:
        self.cdr = cdr
        self.order = order

    def structs(self, codes: str, *, as_bits: bool) -> Phases:
        """Return the structs of a run, one for each start offset modulo 8."""
        letters = codes.translate(_AS_BITS) if as_bits else codes
        return Phases(letters, self.order, cdr=self.cdr)


def _padded(letters: str, phase: int) -> str:
    parts = []
    at = phase
    for outgoing in letters:
        size = SIZES[outgoing]
        pad = -at % size
        parts.append("x" * pad + outgoing)
        at += pad + size
    return "".join(parts)


def inline_codes(kind: Type, inline_max: int, known: dict[int, str | None]) -> str | None:
    """Return the codes of a type that consists of numbers only and has a fixed size, None for any other.

    Args:
        inline_max: longest fixed array that may count; one of no items never does.
        known: results so far, by the record's identity; extended.
    """
    if isinstance(kind, Number):
        return kind.code
    if isinstance(kind, Array) and isinstance(kind.item, Number) and not kind.item.octet:
        return kind.item.code * kind.count if 0 < kind.count <= inline_max else None
    if not isinstance(kind, Record):
        return None
    if id(kind) not in known:
        codes: str | None = ""
        for _, field in kind.fields:
            more = inline_codes(field, inline_max, known)
            if more is None or codes is None or len(codes) + len(more) > _INLINE_MAX:
                codes = None
                break
            codes += more
        known[id(kind)] = codes
    return known[id(kind)]


def runs(record: Record, codes: Callable[[Type], str | None]) -> Iterator[tuple[list[tuple[str, Type]], bool]]:
    """Yield the fields of a record in order: those together that one format reads (True), any other alone (False).

    Args:
        codes: as ``inline_codes``.
    """
    run: list[tuple[str, Type]] = []
    left = _RUN_MAX
    for name, kind in record.fields:
        found = codes(kind)
        if found is not None and (isinstance(kind, Number) or len(found) <= left):
            left -= len(found)
            run.append((name, kind))
            continue
        if run:
            yield run, True
            run = []
        yield [(name, kind)], False
    if run:
        yield run, True
