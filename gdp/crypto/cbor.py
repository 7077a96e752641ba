"""Deterministic CBOR: the strict reader (the writer is ``cbor_writer``).

Sans-I/O. Source: RFC 8949, section 4.2.1. Bytes have one reading or none: the writer would have written bit for bit
what this reader accepts. So no signed value has two encodings. The reader is our own because it must bound depth and
items *before* they cost anything. It takes about 13 us for an advertisement with its evidence.

Allowed are integers of 64 bits, byte and text strings, arrays, maps with text keys, false, true, null and floats. Not
allowed: tags, indefinite lengths, other simple values, and anything not in its shortest form.
"""

from __future__ import annotations

import struct
from typing import Final, NoReturn, TypeAlias

from gdp.crypto.cbor_writer import encode
from gdp.errors import DropReason, StatementError
from gdp.limits import CBOR_DEPTH_MAX, CONTROL_MAX_BYTES

__all__ = ["ITEMS_MAX", "Value", "decode", "encode"]

Value: TypeAlias = "bool | int | float | bytes | str | list[Value] | dict[str, Value] | None"

ITEMS_MAX: Final = 2_048  # bounds one decode to about 1 ms and 250 KiB; a link state has 1,100 at most
_SIMPLE: Final[dict[int, bool | None]] = {0xF4: False, 0xF5: True, 0xF6: None}
_FLOATS: Final = {0xF9: struct.Struct("!e"), 0xFA: struct.Struct("!f"), 0xFB: struct.Struct("!d")}
_NAN: Final = b"\xf9\x7e\x00"


def decode(wire: bytes, max_bytes: int = CONTROL_MAX_BYTES) -> Value:
    """Read one deterministic item that fills ``wire`` exactly.

    Raises:
        StatementError: MALFORMED, for any other bytes; never another exception.
    """
    if len(wire) > max_bytes:
        _refuse(f"{len(wire)} bytes, at most {max_bytes} allowed")
    reader = _Reader(wire)
    value = reader.item(0)
    if reader.at != len(wire):
        _refuse("bytes after the end")
    return value


def _refuse(detail: str) -> NoReturn:
    raise StatementError(DropReason.MALFORMED, detail)


class _Reader:
    """A cursor over the wire; ``items_left`` bounds the work, the depth argument bounds the stack."""

    __slots__ = ("at", "items_left", "wire")

    def __init__(self, wire: bytes) -> None:
        self.wire = wire
        self.at = 0
        self.items_left = ITEMS_MAX

    def item(self, depth: int) -> Value:
        """Read the item at the cursor; ``depth`` counts the containers around it."""
        wire, at = self.wire, self.at
        if at >= len(wire):
            _refuse("ends within an item")
        self.items_left -= 1
        if self.items_left < 0:
            _refuse(f"more than {ITEMS_MAX} items")
        initial = wire[at]
        if initial >= 0xE0:
            return self._simple_or_float(initial)
        major = initial >> 5
        argument = initial & 0x1F
        at += 1
        if argument >= 24:
            argument, at = self._long_argument(argument, at)
        if 2 <= major <= 3:
            end = at + argument
            if end > len(wire):
                _refuse("ends within a string")
            self.at = end
            return wire[at:end] if major == 2 else _text(wire[at:end])
        self.at = at
        if major == 0:
            return argument
        if major == 1:
            return -1 - argument
        if major == 6:
            _refuse("a tag inside")
        if depth >= CBOR_DEPTH_MAX:
            _refuse(f"nested deeper than {CBOR_DEPTH_MAX}")
        if argument > len(wire) - at:
            _refuse("ends within a container")
        if major == 4:
            return [self.item(depth + 1) for _ in range(argument)]
        return self._map(argument, depth + 1)

    def _map(self, pairs: int, depth: int) -> dict[str, Value]:
        wire = self.wire
        result: dict[str, Value] = {}
        previous = b""
        for _ in range(pairs):
            start = self.at
            key = self._key(depth)
            encoded = wire[start : self.at]
            if encoded <= previous:
                _refuse("map keys not in order, or one twice")
            previous = encoded
            result[key] = self.item(depth)
        return result

    def _key(self, depth: int) -> str:
        start = self.at
        length = self.wire[start] - 0x60 if start < len(self.wire) else -1
        if 0 <= length < 24:  # the usual short key, without the cost of the general case
            self.at = start + 1 + length
            raw = self.wire[start + 1 : self.at]
            if len(raw) != length:
                _refuse("ends within a map key")
            return _text(raw)
        key = self.item(depth)
        if not isinstance(key, str):
            _refuse("a map key that is not text")
        return key

    def _long_argument(self, info: int, at: int) -> tuple[int, int]:
        """Return the argument that follows its initial byte, and the cursor behind it."""
        if info > 27:
            _refuse("an indefinite or reserved length")
        width = 1 << (info - 24)
        end = at + width
        if end > len(self.wire):
            _refuse("ends within a head")
        argument = int.from_bytes(self.wire[at:end], "big")
        if argument < (24 if width == 1 else 1 << (4 * width)):
            _refuse("not the shortest form")
        return argument, end

    def _simple_or_float(self, initial: int) -> Value:
        if initial in _SIMPLE:
            self.at += 1
            return _SIMPLE[initial]
        form = _FLOATS.get(initial)
        if form is None:
            _refuse("a simple value other than false, true and null")
        end = self.at + 1 + form.size
        encoded = self.wire[self.at : end]
        if len(encoded) != 1 + form.size:
            _refuse("ends within a float")
        number: float = form.unpack_from(encoded, 1)[0]
        if (encoded != _NAN) if number != number else _fits_shorter(number, initial):  # noqa: PLR0124 (NaN)
            _refuse("a float not in its shortest form")
        self.at = end
        return number


def _text(raw: bytes) -> str:
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise StatementError(DropReason.MALFORMED, "text that is not UTF-8") from error


def _fits_shorter(number: float, initial: int) -> bool:
    """Return whether the next shorter float form carries ``number`` exactly."""
    shorter = _FLOATS.get(initial - 1)
    if shorter is None:
        return False
    try:
        return bool(shorter.unpack(shorter.pack(number))[0] == number)
    except OverflowError:
        return False
