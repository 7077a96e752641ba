"""Native form of the leaves: their own bytes, uninterpreted, so that reading and writing only normalises a message.

Sans-I/O. Used for the canonical form (padding zeroed, little-endian, bools 0 or 1), and to convert big-endian CDR.
"""

from __future__ import annotations

from proxy.serial.dialect import MisfitError, Wide
from proxy.serial.schema import Number


class NativeDialect:
    """Floats as bits, longer leaves as bytes."""

    as_bits = True
    inline_max = 64
    guarded = ""

    def plain(self, values: tuple[float, ...]) -> bool:  # noqa: ARG002
        """Never called: numbers are bits already."""
        return True

    def number(self, code: str, value: float, bits: int) -> object:  # noqa: ARG002
        """Never called: numbers are bits already."""
        return bits

    def bits(self, code: str, value: object) -> int:  # noqa: ARG002
        """Return the bits unchanged."""
        if not isinstance(value, int):
            raise MisfitError("bits are whole numbers")
        return value

    def text(self, raw: memoryview) -> object:
        """Return the bytes."""
        return raw

    def untext(self, value: object) -> bytes:
        """Return the bytes."""
        return bytes(_view(value))

    def wide(self, units: bytes, layout: Wide) -> object:
        """Return units and layout together."""
        return (layout, units)

    def unwide(self, value: object) -> tuple[Wide, bytes]:
        """Return layout and units."""
        match value:
            case (Wide() as layout, bytes() as units):
                return layout, units
        raise MisfitError("a wide string is its layout and its units")

    def array(self, item: Number, raw: memoryview) -> object:
        """Return the bytes; bools are normalised to 0 or 1."""
        if item.code == "?":
            return memoryview(bytes(map(bool, raw)))
        return raw

    def unarray(self, item: Number, value: object) -> bytes | memoryview:  # noqa: ARG002
        """Return the bytes."""
        return _view(value)


def _view(value: object) -> memoryview:
    if not isinstance(value, memoryview):
        raise MisfitError("not bytes")
    return value
