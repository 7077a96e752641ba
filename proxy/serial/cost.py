"""What a message of a type costs at the least: values that exist whatever its bytes say, and bytes of fixed fields.

Layer: sans-I/O. A fixed array counts with all its items, in nested types too, so that a short message or a short
definition cannot stand for millions of values.
"""

from __future__ import annotations

from typing import Final

from proxy.serial.schema import Array, Number, Sequence, Text, Type

__all__ = ["COST_MAX", "fixed_bytes", "items_of"]

COST_MAX: Final = 1 << 40  # costs are counted up to here


def items_of(kind: Type, known: dict[int, int]) -> int:
    """Return how many records, lists and texts one value holds, itself included; items of sequences are not counted.

    Args:
        kind: a field's type.
        known: answers already found, by the record's identity; filled.
    """
    if isinstance(kind, Number):
        return 0
    if isinstance(kind, Text | Sequence):
        return 1
    if isinstance(kind, Array):
        return min(1 + kind.count * items_of(kind.item, known), COST_MAX)
    if id(kind) not in known:
        known[id(kind)] = min(1 + sum(items_of(field, known) for _, field in kind.fields), COST_MAX)
    return known[id(kind)]


def fixed_bytes(kind: Type, known: dict[int, int]) -> int:
    """Return how many bytes one value takes at the least, padding not counted; ``known`` as in ``items_of``."""
    if isinstance(kind, Number):
        return kind.size
    if isinstance(kind, Text | Sequence):
        return 4
    if isinstance(kind, Array):
        return min(kind.count * fixed_bytes(kind.item, known), COST_MAX)
    if id(kind) not in known:
        known[id(kind)] = min(sum(fixed_bytes(field, known) for _, field in kind.fields), COST_MAX)
    return known[id(kind)]
