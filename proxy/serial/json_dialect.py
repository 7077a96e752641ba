"""JSON form of the leaves of a message: exact, and readable where possible.

Sans-I/O.
Source: rosbridge for base64; RFC 7493 (I-JSON) 2.2 for integers beyond 2^53.
Other conventions: ``docs/reference/serialisation.md``.
"""

from __future__ import annotations

import array
import struct
from math import isfinite
from typing import Final, TypeAlias

import numpy as np
import orjson
import pybase64
from numpy.typing import NDArray

from proxy.serial.dialect import BITS, FLOATS, PATTERNS, MisfitError, Wide, flag
from proxy.serial.schema import Number

_Numbers: TypeAlias = "NDArray[np.generic]"

_SAFE: Final = (1 << 53) - 1  # RFC 7493, section 2.2
_DTYPES: Final = {code: np.dtype(f"<{code}") for code in "bBhHiIqQfd"}
_TOKENS: Final = {
    "f": {0x7F800000: "Infinity", 0xFF800000: "-Infinity", 0x7FC00000: "NaN"},
    "d": {0x7FF0000000000000: "Infinity", 0xFFF0000000000000: "-Infinity", 0x7FF8000000000000: "NaN"},
}
_BITS: Final = {code: {token: bits for bits, token in tokens.items()} for code, tokens in _TOKENS.items()}
# The one float32 (of either sign) whose shortest digits, read as a double and rounded, give its neighbour; found by a
# test of all 2^31. Its lists are written with the digits of doubles.
_TWICE_ROUNDED: Final = 0x15AE43FD
_NAN_PREFIX: Final = "NaN:"  # followed by the bits in hex: any other NaN


class JsonDialect:
    """Numbers, strings and base64; objects and tokens only for values without a JSON form."""

    as_bits = False
    inline_max = 64
    guarded = "qQ"

    def plain(self, values: tuple[float, ...]) -> bool:
        """Return whether no value is infinite or NaN; the test is the sum, which such a value makes so too."""
        return isfinite(sum(values))

    def number(self, code: str, value: float, bits: int) -> object:
        """Return a number, a token for an infinity or NaN, or text for an integer beyond 2^53."""
        if code in _TOKENS:
            return value if isfinite(value) else _token(code, bits)
        return value if -_SAFE <= value <= _SAFE else str(value)

    def bits(self, code: str, value: object) -> int | bool:
        """Return the value to pack for a number, a token or a text of digits."""
        if code == "?":
            return flag(value)
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise MisfitError("not a number")
        if code in FLOATS:
            return _untoken(code, value) if isinstance(value, str) else _pattern(code, value)
        if isinstance(value, str):
            return _integer(value)
        if isinstance(value, float):
            raise MisfitError("not a whole number")
        return value

    def text(self, raw: memoryview) -> object:
        """Return a string, or an object with the base64 of bytes that are not UTF-8."""
        try:
            return str(raw, "utf-8")
        except UnicodeDecodeError:
            return {"base64": pybase64.b64encode_as_string(raw)}

    def untext(self, value: object) -> bytes:
        """Return the bytes of either form."""
        if isinstance(value, str):
            return value.encode()
        if isinstance(value, dict):
            return _unbase64(value["base64"])
        raise MisfitError("not a string")

    def wide(self, units: bytes, layout: Wide) -> object:
        """Return a string where that is exact in the first layout, else an object that names the layout."""
        text = _wide_text(units, layout)
        if text is None:
            return {"wide": layout.value, "base64": pybase64.b64encode_as_string(units)}
        return text if layout is Wide.FOUR else {"wide": layout.value, "text": text}

    def unwide(self, value: object) -> tuple[Wide, bytes]:
        """Return layout and units of any form."""
        if isinstance(value, str):
            return Wide.FOUR, _wide_units(value, Wide.FOUR)
        if not isinstance(value, dict):
            raise MisfitError("not a wide string")
        layout = Wide(value["wide"])
        if "text" in value:
            text = value["text"]
            if not isinstance(text, str):
                raise MisfitError("not a wide string")
            return layout, _wide_units(text, layout)
        return layout, _unbase64(value["base64"])

    def array(self, item: Number, raw: memoryview) -> object:
        """Return base64 for octets, else a list; an array of plain numbers remains an array until it is written."""
        if item.octet:
            return pybase64.b64encode_as_string(raw)
        if item.code == "?":
            return list(map(bool, raw))
        values = np.frombuffer(raw, dtype=_DTYPES[item.code])
        if item.code in FLOATS:
            return _plain(item.code, values) if np.isfinite(values).all() else _with_tokens(item.code, values)
        if item.size == 8 and values.size and (values.max() > _SAFE or values.min() < -_SAFE):
            return [number if -_SAFE <= number <= _SAFE else str(number) for number in values.tolist()]
        return _aligned(values)

    def unarray(self, item: Number, value: object) -> bytes | memoryview:
        """Return the little-endian bytes of either form."""
        if item.octet:
            return _unbase64(value)
        if not isinstance(value, list):
            raise MisfitError("an array is a list")
        if item.code == "?":
            return bytes(flag(each) for each in value)
        try:
            return memoryview(array.array(item.code, value)).cast("B")
        except TypeError:  # not all are plain numbers
            return self._unarray_with_texts(item.code, value)

    def _unarray_with_texts(self, code: str, values: list[object]) -> memoryview:
        texts = [(index, value) for index, value in enumerate(values) if isinstance(value, str)]
        plain = values.copy()
        for index, _ in texts:
            plain[index] = 0
        packed = bytearray(struct.pack(f"<{len(plain)}{code}", *plain))
        pattern = struct.Struct(f"<{BITS.get(code, code)}")
        for index, text in texts:
            pattern.pack_into(packed, index * pattern.size, self.bits(code, text))
        return memoryview(packed)


def _token(code: str, bits: int) -> str:
    return _TOKENS[code].get(bits) or f"{_NAN_PREFIX}{bits:x}"


def _untoken(code: str, token: str) -> int:
    if token in _BITS[code]:
        return _BITS[code][token]
    if not token.startswith(_NAN_PREFIX):
        raise MisfitError("not a number")
    return int(token[len(_NAN_PREFIX) :], 16)


def _pattern(code: str, value: float) -> int:
    (bits,) = PATTERNS[code].unpack(FLOATS[code].pack(value))
    return int(bits)


def _integer(text: str) -> int:
    if len(text) > 20:
        raise MisfitError("not a 64-bit integer")
    return int(text)


def _aligned(values: _Numbers) -> _Numbers:
    return values if values.flags.aligned else values.copy()


def _plain(code: str, values: _Numbers) -> _Numbers:
    """Return the array in a form that orjson can write."""
    if code == "f" and ((values.view("<u4") & 0x7FFFFFFF) == _TWICE_ROUNDED).any():
        return values.astype(np.float64)
    return _aligned(values)


def _with_tokens(code: str, values: _Numbers) -> list[object]:
    # orjson writes an array of float32 with their own digits; a NaN or infinity is returned as None.
    items: list[object] = orjson.loads(orjson.dumps(_plain(code, values), option=orjson.OPT_SERIALIZE_NUMPY))
    patterns = values.view(f"<u{values.itemsize}")
    for index in np.flatnonzero(~np.isfinite(values)).tolist():
        items[index] = _token(code, int(patterns[index]))
    return items


def _unbase64(value: object) -> bytes:
    if not isinstance(value, str):
        raise MisfitError("not base64")
    return pybase64.b64decode(value, validate=True)


def _wide_text(units: bytes, layout: Wide) -> str | None:
    """Return the text that encodes to exactly these units, None where there is none."""
    try:
        text = units.decode("utf-32-le" if layout is Wide.FOUR else "utf-16-le")
    except UnicodeDecodeError:
        return None
    return text if _wide_units(text, layout) == units else None


def _wide_units(text: str, layout: Wide) -> bytes:
    return text.encode("utf-32-le" if layout is Wide.FOUR else "utf-16-le")
