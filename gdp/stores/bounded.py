"""Bounded read of a file, without a buffer of the limit's length for a short file.

I/O.
"""

from __future__ import annotations

from typing import BinaryIO, Final

__all__ = ["read_at_most"]

_PIECE_BYTES: Final = 16 << 10


def read_at_most(file: BinaryIO, limit: int) -> bytes:
    """Return a file's bytes up to its end, or the first ``limit + 1`` bytes if it is longer."""
    pieces = []
    left = limit + 1
    while left and (piece := file.read(min(left, _PIECE_BYTES))):
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)
