"""Cost of a message type: minimum number of values, whatever its bytes, and minimum bytes of fixed fields.

Sans-I/O. A fixed array counts with all its items, in nested types too, so that a short message or a short definition
cannot represent millions of values.
"""

from __future__ import annotations

from typing import Final

from proxy.serial.schema import Array, Number, Sequence, Text, Type

COST_MAX: Final = 1 << 40  # costs are counted up to this number


def items_of(kind: Type, known: dict[int, int]) -> int:
    """Return the number of records, lists and texts in one value, itself included; items of sequences are not counted.

    Args:
        known: results so far, by the record's identity; extended.
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
    """Return the minimum number of bytes of one value, padding not counted; ``known`` as in ``items_of``."""
    if isinstance(kind, Number):
        return kind.size
    if isinstance(kind, Text | Sequence):
        return 4
    if isinstance(kind, Array):
        return min(kind.count * fixed_bytes(kind.item, known), COST_MAX)
    if id(kind) not in known:
        known[id(kind)] = min(sum(fixed_bytes(field, known) for _, field in kind.fields), COST_MAX)
    return known[id(kind)]
