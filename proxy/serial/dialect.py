"""Dialect interface: an encoding's form of the leaves of a message; the traversal is common to all encodings.

Sans-I/O. ``json_dialect``, ``cbor_dialect`` and ``native_dialect`` implement it.
"""

from __future__ import annotations

import struct
from enum import Enum
from typing import Final, Protocol

from proxy.serial.schema import Number

# The unsigned code of the same width, for the exact bits of a float; other codes map to themselves.
BITS: Final = {"f": "I", "d": "Q"}
FLOATS: Final = {code: struct.Struct(f"<{code}") for code in BITS}
PATTERNS: Final = {code: struct.Struct(f"<{bits}") for code, bits in BITS.items()}


class MisfitError(ValueError):
    """A value or a run of bytes that the type does not allow. This package's public functions translate it."""


def flag(value: object) -> bool:
    """Return a bool as both dialects of numbers hold it. Raises ``MisfitError``: it is none."""
    if not isinstance(value, bool):
        raise MisfitError("a bool is true or false")
    return value


class Wide(Enum):
    """CDR layout of a wide string; three generations of middlewares differ.

    The value is the word used in an encoded message.
    """

    FOUR = "4"  # count of units, four bytes each: Fast CDR 1, Cyclone DDS up to Iron
    TWO = "2"  # count of units, two bytes each: Fast CDR 2
    TWO_BYTES = "2b"  # count of bytes, two bytes each: DDS XTypes 1.2 on


class Dialect(Protocol):
    """Conversion of leaves to values and back. Values are those of the encoding's own library.

    The ``un`` methods get untrusted values: for invalid ones they raise ``MisfitError``, ``TypeError``, ``ValueError``,
    ``OverflowError`` or ``struct.error``, and nothing else.
    """

    as_bits: bool  # floats are carried as their bits, always exact; no ``plain``, no ``number``
    inline_max: int  # fixed arrays of up to this many numbers are processed together with their neighbours
    guarded: str  # codes whose every value must pass through ``number``

    def plain(self, values: tuple[float, ...]) -> bool:
        """Return whether a run of numbers needs no conversion; False requires ``number`` for each."""

    def number(self, code: str, value: float, bits: int) -> object:
        """Return the form of one number. ``bits``: its pattern where it is a float, else the value."""

    def bits(self, code: str, value: object) -> int | bool:
        """Return the value to pack for one number: a float's bits, an integer itself."""

    def text(self, raw: memoryview) -> object:
        """Return the form of a string (``raw``: without terminator, any bytes)."""

    def untext(self, value: object) -> bytes:
        """Return the bytes of a string."""

    def wide(self, units: bytes, layout: Wide) -> object:
        """Return the form of a wide string (``units``: little-endian, of the layout's width)."""

    def unwide(self, value: object) -> tuple[Wide, bytes]:
        """Return layout and units."""

    def array(self, item: Number, raw: memoryview) -> object:
        """Return the form of an array of numbers (``raw``: little-endian)."""

    def unarray(self, item: Number, value: object) -> bytes | memoryview:
        """Return the little-endian bytes of an array of numbers, a whole number of them."""
