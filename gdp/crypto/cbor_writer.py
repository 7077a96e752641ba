"""Deterministic CBOR: the writer, with one encoding for each value (the reader is ``cbor``).

Sans-I/O. Source: RFC 8949, section 4.2.1. It is our own for the same reason as the reader: signed bytes must not depend
on the version of a library. (cbor2 before 6.0 does not write half-precision floats from 32768 on in their shortest
form.)
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from operator import itemgetter
from typing import Final

from gdp.errors import LocalError
from gdp.limits import CBOR_DEPTH_MAX

__all__ = ["encode"]

_first: Final = itemgetter(0)
_HALF: Final = struct.Struct("!e")
_SINGLE: Final = struct.Struct("!f")
_DOUBLE: Final = struct.Struct("!d")


def encode(value: object) -> bytes:
    """Return the one deterministic encoding of ``value``; ``cbor.decode`` reads it.

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
        pieces.append(_text(value))
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
    elif isinstance(value, Mapping):
        pieces.append(_head(5, len(value)))
        for key, item in sorted(((_key(key), item) for key, item in value.items()), key=_first):
            pieces.append(key)
            _write(item, pieces, depth + 1)
    else:
        raise LocalError(f"cannot be written as CBOR: {type(value).__name__}")


def _head(major: int, argument: int) -> bytes:
    if argument < 24:
        return bytes((major << 5 | argument,))
    if argument >= 1 << 64:
        raise LocalError("a whole number of more than 64 bits")
    width = 1 if argument < 1 << 8 else 2 if argument < 1 << 16 else 4 if argument < 1 << 32 else 8
    return bytes((major << 5 | 23 + width.bit_length(),)) + argument.to_bytes(width, "big")


def _key(key: object) -> bytes:
    if not isinstance(key, str):
        raise LocalError("a map key that is not text")
    return _text(key)


def _text(text: str) -> bytes:
    try:
        raw = text.encode()
    except UnicodeEncodeError as error:
        raise LocalError("text that is not Unicode") from error
    return _head(3, len(raw)) + raw


def _float(number: float) -> bytes:
    if number != number:  # noqa: PLR0124 (NaN has one form here)
        return b"\xf9\x7e\x00"
    for initial, form in ((b"\xf9", _HALF), (b"\xfa", _SINGLE)):
        try:
            packed = form.pack(number)
        except OverflowError:
            continue
        if form.unpack(packed)[0] == number:
            return initial + packed
    return b"\xfb" + _DOUBLE.pack(number)
