"""Reading a file of at most so many bytes, without a buffer of that length for a short one.

Layer: I/O.
"""

from __future__ import annotations

from typing import BinaryIO, Final

__all__ = ["read_at_most"]

_PIECE_BYTES: Final = 16 << 10


def read_at_most(file: BinaryIO, limit: int) -> bytes:
    """Return a file's bytes up to its end, or the first ``limit + 1`` where it is longer."""
    pieces = []
    left = limit + 1
    while left and (piece := file.read(min(left, _PIECE_BYTES))):
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)
