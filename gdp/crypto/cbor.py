"""Deterministic CBOR: a strict reader, and a writer with one encoding for each value.

Sans-I/O. Source: RFC 8949, section 4.2.1. Bytes have one reading or none: the writer would have written bit for bit
what the reader accepts. So no signed value has two encodings. The reader is our own because it must bound depth and
items *before* they cost anything. It takes about 13 us for an advertisement with its evidence. The writer is our own
because signed bytes must not depend on the version of a library. (cbor2 before 6.0 does not write half-precision floats
from 32768 on in their shortest form.)

Allowed are integers of 64 bits, byte and text strings, arrays, maps with text keys, false, true, null and floats. Not
allowed: tags, indefinite lengths, other simple values, and anything not in its shortest form.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, NoReturn, TypeAlias

from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CBOR_DEPTH_MAX, CONTROL_MAX_BYTES

Value: TypeAlias = "bool | int | float | bytes | str | list[Value] | dict[str, Value] | None"

ITEMS_MAX: Final = 2_048  # bounds one decode to about 1 ms and 250 KiB; a link state has 1,100 at most
_SIMPLE: Final[dict[int, bool | None]] = {0xF4: False, 0xF5: True, 0xF6: None}
_HALF: Final = struct.Struct("!e")
_SINGLE: Final = struct.Struct("!f")
_DOUBLE: Final = struct.Struct("!d")
_FLOATS: Final = {0xF9: _HALF, 0xFA: _SINGLE, 0xFB: _DOUBLE}
_NAN: Final = b"\xf9\x7e\x00"
_SHORT_HEADS: Final = tuple(bytes((initial,)) for initial in range(256))  # by initial byte
_KEYS_MAX: Final = 1_024  # map keys whose other form is kept
_SHORT_KEY_BYTES: Final = 24  # with the head, which then has the length


def decode(wire: bytes, max_bytes: int = CONTROL_MAX_BYTES) -> Value:
    """Read one deterministic item that fills ``wire`` exactly.

    Raises:
        StatementError: MALFORMED, for any other bytes; never another exception.
    """
    if len(wire) > max_bytes:
        _refuse(f"{len(wire)} bytes, at most {max_bytes} allowed")
    reader = _Reader(wire)
    value = reader.item(0)
    if reader.at != reader.size:
        _refuse("bytes after the end")
    return value


def _refuse(detail: str) -> NoReturn:
    raise StatementError(DropReason.MALFORMED, detail)


class _Reader:
    """A cursor over the wire; ``items_left`` bounds the work, the depth argument bounds the stack."""

    __slots__ = ("at", "items_left", "size", "wire")

    def __init__(self, wire: bytes) -> None:
        self.wire, self.size = wire, len(wire)
        self.at = 0
        self.items_left = ITEMS_MAX

    def item(self, depth: int) -> Value:
        """Read the item at the cursor; ``depth`` counts the containers around it."""
        wire, size, at = self.wire, self.size, self.at
        if at >= size:
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
        if argument == 24 and at < size and wire[at] >= 24:  # the usual length of a name or a key
            argument, at = wire[at], at + 1
        elif argument >= 24:
            argument, at = self._long_argument(argument, at)
        if 2 <= major <= 3:
            end = at + argument
            if end > size:
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
        if argument > size - at:
            _refuse("ends within a container")
        if major == 4:
            return [self.item(depth + 1) for _ in range(argument)]
        return self._map(argument, depth + 1)

    def _map(self, pairs: int, depth: int) -> dict[str, Value]:
        wire, size = self.wire, self.size
        result: dict[str, Value] = {}
        previous = b""
        for _ in range(pairs):
            start = self.at
            end = start + wire[start] - 0x60 + 1 if start < size else 0
            if start < end <= size and end - start <= _SHORT_KEY_BYTES:  # the usual key, without the general case
                encoded = wire[start:end]
                key = _short_key(encoded)
                self.at = end
            else:
                item = self.item(depth)
                if not isinstance(item, str):
                    _refuse("a map key that is not text")
                key, encoded = item, wire[start : self.at]
            if encoded <= previous:
                _refuse("map keys not in order, or one twice")
            previous = encoded
            result[key] = self.item(depth)
        return result

    def _long_argument(self, info: int, at: int) -> tuple[int, int]:
        """Return the argument that follows its initial byte, and the cursor behind it."""
        if info > 27:
            _refuse("an indefinite or reserved length")
        width = 1 << (info - 24)
        end = at + width
        if end > self.size:
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


@lru_cache(_KEYS_MAX)
def _short_key(encoded: bytes) -> str:
    """Return the text of a map key of up to 23 bytes, encoded with its head."""
    return _text(encoded[1:])


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


def encode(value: object) -> bytes:
    """Return the one deterministic encoding of ``value``; ``decode`` reads it.

    Args:
        value: None, a flag, a number, bytes, text, a list or tuple of these, or a mapping from text to these. Whole
            numbers have 64 bits.

    Raises:
        LocalError: anything else, or nested deeper than ``CBOR_DEPTH_MAX``.
    """
    pieces: list[bytes] = []
    _write(value, pieces, 0)
    return b"".join(pieces)


def _write(value: object, pieces: list[bytes], depth: int) -> None:
    if isinstance(value, bytes):
        pieces += (_head(2, len(value)), value)
    elif isinstance(value, str):
        pieces.append(_text_item(value))
    elif value is None:
        pieces.append(b"\xf6")
    elif isinstance(value, bool):
        pieces.append(b"\xf5" if value else b"\xf4")
    elif isinstance(value, int):
        pieces.append(_head(0, value) if value >= 0 else _head(1, -1 - value))
    elif isinstance(value, float):
        pieces.append(_float(value))
    elif depth >= CBOR_DEPTH_MAX:
        raise LocalError(f"nested deeper than {CBOR_DEPTH_MAX}")
    elif isinstance(value, list | tuple):
        pieces.append(_head(4, len(value)))
        for item in value:
            _write(item, pieces, depth + 1)
    elif isinstance(value, dict | Mapping):  # the usual kind first
        pieces.append(_head(5, len(value)))
        for key in sorted(value, key=_key):
            pieces.append(_key(key))
            _write(value[key], pieces, depth + 1)
    else:
        raise LocalError(f"cannot be written as CBOR: {type(value).__name__}")


def _head(major: int, argument: int) -> bytes:
    if argument < 24:
        return _SHORT_HEADS[major << 5 | argument]
    if argument >= 1 << 64:
        raise LocalError("a whole number of more than 64 bits")
    width = 1 if argument < 1 << 8 else 2 if argument < 1 << 16 else 4 if argument < 1 << 32 else 8
    return bytes((major << 5 | 23 + width.bit_length(),)) + argument.to_bytes(width, "big")


@lru_cache(_KEYS_MAX, typed=True)  # a field's key is that of every statement of its type
def _key(key: object) -> bytes:
    if not isinstance(key, str):
        raise LocalError("a map key that is not text")
    return _text_item(key)


def _text_item(text: str) -> bytes:
    try:
        raw = text.encode()
    except UnicodeEncodeError as error:
        raise LocalError("text that is not Unicode") from error
    return _head(3, len(raw)) + raw


def _float(number: float) -> bytes:
    if number != number:  # noqa: PLR0124 (NaN has one form here)
        return _NAN
    for initial, form in ((b"\xf9", _HALF), (b"\xfa", _SINGLE)):
        try:
            packed = form.pack(number)
        except OverflowError:
            continue
        if form.unpack(packed)[0] == number:
            return initial + packed
    return b"\xfb" + _DOUBLE.pack(number)
