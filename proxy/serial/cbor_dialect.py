"""CBOR form of the leaves of a message: arrays of numbers are typed arrays, which are copied as a whole.

Sans-I/O.
Source: RFC 8949; RFC 8746 (typed arrays, tags 64 to 86, little-endian).
"""

from __future__ import annotations

from typing import Final

from cbor2 import CBORTag

from proxy.serial.dialect import FLOATS, PATTERNS, MisfitError, Wide, flag
from proxy.serial.schema import Number

# RFC 8746, section 2.1
_TAGS: Final = {"B": 64, "H": 69, "I": 70, "Q": 71, "b": 72, "h": 77, "i": 78, "q": 79, "f": 85, "d": 86}
_QUIET: Final = {"f": 0x7FC00000, "d": 0x7FF8000000000000}  # the one NaN that a CBOR float represents here


class CborDialect:
    """Numbers and strings as CBOR's own; any other NaN as a typed array of one."""

    as_bits = False
    inline_max = 0
    guarded = ""

    def plain(self, values: tuple[float, ...]) -> bool:
        """Return whether no value is NaN; the test is the sum, which a NaN makes NaN."""
        total = sum(values)
        return total == total  # noqa: PLR0124

    def number(self, code: str, value: float, bits: int) -> object:
        """Return a number, or a tagged byte string for a NaN with other bits than the usual ones."""
        if code not in FLOATS or value == value or bits == _QUIET[code]:  # noqa: PLR0124
            return value
        return CBORTag(_TAGS[code], PATTERNS[code].pack(bits))

    def bits(self, code: str, value: object) -> int | bool:
        """Return the value to pack for a number of either form."""
        if code == "?":
            return flag(value)
        if code in FLOATS:
            if isinstance(value, CBORTag):
                raw = _tagged(_TAGS[code], value)
            elif isinstance(value, int | float) and not isinstance(value, bool):
                if value != value:  # noqa: PLR0124
                    return _QUIET[code]
                raw = FLOATS[code].pack(value)
            else:
                raise MisfitError("not a number")
            (pattern,) = PATTERNS[code].unpack(raw)
            return int(pattern)
        if isinstance(value, bool) or not isinstance(value, int):
            raise MisfitError("not a whole number")
        return value

    def text(self, raw: memoryview) -> object:
        """Return a text string, or a byte string for bytes that are not UTF-8."""
        try:
            return str(raw, "utf-8")
        except UnicodeDecodeError:
            return bytes(raw)

    def untext(self, value: object) -> bytes:
        """Return the bytes of either form."""
        if isinstance(value, str):
            return value.encode()
        if isinstance(value, bytes):
            return value
        raise MisfitError("not a string")

    def wide(self, units: bytes, layout: Wide) -> object:
        """Return the layout and the units as a typed array."""
        return [layout.value, CBORTag(_TAGS["I" if layout is Wide.FOUR else "H"], units)]

    def unwide(self, value: object) -> tuple[Wide, bytes]:
        """Return layout and units."""
        if not isinstance(value, list) or len(value) != 2:
            raise MisfitError("not a wide string")
        layout = Wide(value[0])
        return layout, _tagged(_TAGS["I" if layout is Wide.FOUR else "H"], value[1])

    def array(self, item: Number, raw: memoryview) -> object:
        """Return a typed array; there is none for bools, which become a list."""
        if item.code == "?":
            return list(map(bool, raw))
        return CBORTag(_TAGS[item.code], bytes(raw))

    def unarray(self, item: Number, value: object) -> bytes | memoryview:
        """Return the little-endian bytes."""
        if item.code == "?":
            if not isinstance(value, list):
                raise MisfitError("an array of bools is a list")
            return bytes(flag(each) for each in value)
        raw = _tagged(_TAGS[item.code], value)
        if len(raw) % item.size:
            raise MisfitError("a typed array of a broken number")
        return raw


def _tagged(tag: int, value: object) -> bytes:
    if not isinstance(value, CBORTag) or value.tag != tag or not isinstance(value.value, bytes):
        raise MisfitError(f"not a typed array of tag {tag}")
    raw: bytes = value.value
    return raw
