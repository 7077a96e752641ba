"""What an encoding must say about the leaves of a message; the walk around them is the same for all.

Place: pure. Implemented by ``json_dialect``, ``cbor_dialect`` and ``native_dialect``.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, Protocol

from proxy.serial.schema import Number

__all__ = ["BITS", "Dialect", "MisfitError", "Wide"]

# The unsigned code of the same width, to take a float's bits apart exactly; others stand for themselves.
BITS: Final = {"f": "I", "d": "Q"}


class MisfitError(ValueError):
    """A value or a run of bytes that the type does not admit. Translated at the edge of this package."""


class Wide(Enum):
    """How a wide string lies in CDR; three generations of middlewares disagree.

    The value is the word used in an encoded message.
    """

    FOUR = "4"  # count of units, four bytes each: Fast CDR 1, Cyclone DDS up to Iron
    TWO = "2"  # count of units, two bytes each: Fast CDR 2
    TWO_BYTES = "2b"  # count of bytes, two bytes each: DDS XTypes 1.2 on


class Dialect(Protocol):
    """Leaves to values and back. Values are what the encoding's own library writes and reads.

    The ``un`` methods are given what a peer sent: they raise ``MisfitError``, ``TypeError``, ``ValueError``,
    ``OverflowError`` or ``struct.error`` for what does not fit, and nothing else.
    """

    as_bits: bool  # floats are carried as their bits, always exact; no ``plain``, no ``number``
    inline_max: int  # fixed arrays of up to this many numbers are handled with their neighbours in one go
    guarded: str  # codes whose every value must pass through ``number``

    def plain(self, values: tuple[float, ...]) -> bool:
        """Whether a run of numbers may stand as it is; False asks for ``number`` on each."""

    def number(self, code: str, value: float, bits: int) -> object:
        """Return the form of one number. ``bits``: its pattern where it is a float, else the value."""

    def bits(self, code: str, value: object) -> int | bool:
        """Return what to pack for one number: a float's bits, an integer itself."""

    def text(self, raw: memoryview) -> object:
        """Return the form of a string (``raw``: without terminator, any bytes)."""

    def untext(self, value: object) -> bytes:
        """Return the bytes of a string."""

    def wide(self, units: bytes, layout: Wide) -> object:
        """Return the form of a wide string (``units``: little-endian, as wide as the layout says)."""

    def unwide(self, value: object) -> tuple[Wide, bytes]:
        """Return layout and units."""

    def array(self, item: Number, raw: memoryview) -> object:
        """Return the form of an array of numbers (``raw``: little-endian)."""

    def unarray(self, item: Number, value: object) -> bytes | memoryview:
        """Return the little-endian bytes of an array of numbers, a whole number of them."""
