"""Bounds of a CBOR text before a library builds its values: items, depth, tags, and lengths the bytes cannot hold.

Sans-I/O. The check takes time proportional to the items and stops at the bound. Tags other than those of typed arrays
are refused: with shared values (tags 28 and 29) a few bytes stand for any number of items, and others make the library
compile or compute something.
Source: RFC 8949, section 3; RFC 8746, section 2.
"""

from __future__ import annotations

from typing import Final

_DEPTH_MAX: Final = 64
_BREAK: Final = 0xFF
_TYPED_ARRAYS: Final = range(64, 88)  # tags


def check_bounds(wire: bytes, items_max: int) -> None:
    """Return if ``wire`` begins with one item within the bounds.

    Args:
        items_max: numbers, texts, arrays, maps and tags in all.

    Raises:
        ValueError: too many items, too deep, another tag than those of typed arrays, or lengths beyond the end.
    """
    open_counts: list[int] = [1]  # items that follow at each level; -1: until a break
    at, left, end = 0, items_max, len(wire)
    while open_counts:
        if open_counts[-1] == 0:
            open_counts.pop()
            continue
        if at >= end:
            raise ValueError("CBOR that ends in the middle")
        head = wire[at]
        at += 1
        if head == _BREAK:
            if open_counts.pop() != -1:
                raise ValueError("a break outside of an indefinite item")
            continue
        if open_counts[-1] > 0:
            open_counts[-1] -= 1
        left -= 1
        if left < 0:
            raise ValueError(f"more than {items_max} items")
        major, info = head >> 5, head & 31
        size = 1 << (info - 24) if 24 <= info <= 27 else 0
        value = int.from_bytes(wire[at : at + size], "big") if size else info
        at += size
        if 28 <= info <= 30 or (info == 31 and major in (0, 1, 6)):
            raise ValueError("a head that CBOR does not have")
        if info == 31 and major in (2, 3, 4, 5):
            open_counts.append(-1)
        elif major in (2, 3):
            at += value
        elif major in (4, 5):
            open_counts.append(value * (major - 3))
        elif major == 6:
            if value not in _TYPED_ARRAYS:
                raise ValueError(f"tag {value}, which is of no typed array")
            open_counts.append(1)
        if at > end or (major in (4, 5) and info != 31 and value > end - at):
            raise ValueError("a length beyond the end")
        if len(open_counts) > _DEPTH_MAX:
            raise ValueError(f"more than {_DEPTH_MAX} levels")
