"""Systematic erasure code over GF(256): any ``k`` of ``k`` shards and their parity shards give all ``k``.

Sans-I/O; it needs NumPy, an optional dependency. Source: Cauchy Reed-Solomon codes with XOR (Blömer et al., ICSI
TR-95-048); the field of RFC 5510, section 8.1 (x^8 + x^4 + x^3 + x^2 + 1).

The coefficient of data shard ``i`` in parity shard ``j`` is ``(128 ^ i) / ((128 + j) ^ i)``: a Cauchy matrix whose
columns are scaled so that the first parity shard is the XOR of the data. Every square submatrix has an inverse.

A product is computed without tables of bytes. For each bit of the coefficients, the shards that have it set are added
(XOR over whole rows). The eight sums are then joined by doubling (Horner's rule).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from gdp.errors import LocalError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    _Rows = npt.NDArray[np.uint64]
    _Picks = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]

DATA_MAX: Final = 128  # shards of a block
PARITY_MAX: Final = 32  # ... and its parity
_POLYNOMIAL: Final = 0x11D
_WORD_BYTES: Final = 8
_LOW_BITS: Final = 0x7F7F7F7F7F7F7F7F  # of each byte of a word, all but the highest bit
_ONES: Final = 0x0101010101010101
_REDUCTION: Final = _POLYNOMIAL & 0xFF


def _powers() -> tuple[list[int], list[int]]:
    """Return the powers of 2 (twice round), and the logarithms of 1 to 255."""
    exponentials, logarithms, value = [0] * 510, [0] * 256, 1
    for exponent in range(255):
        exponentials[exponent] = exponentials[exponent + 255] = value
        logarithms[value] = exponent
        value = value << 1 ^ (_POLYNOMIAL if value & 0x80 else 0)
    return exponentials, logarithms


_EXP, _LOG = _powers()


@lru_cache(maxsize=1)
def is_available() -> bool:
    """Return whether NumPy is installed."""
    return find_spec("numpy") is not None


def encode(shards: Sequence[bytes], count: int) -> list[bytes]:
    """Return the first ``count`` parity shards.

    Args:
        shards: 1 to ``DATA_MAX``, all of one length.
        count: 1 to ``PARITY_MAX``.

    Raises:
        LocalError: bounds.
    """
    k, size = len(shards), len(shards[0]) if shards else 0
    if not 1 <= k <= DATA_MAX or not 1 <= count <= PARITY_MAX or any(len(each) != size for each in shards):
        raise LocalError(f"{count} parity shards of {k} shards, of one length each")
    return [row[:size] for row in _multiply([_picks_of_parity(index, k) for index in range(count)], shards)]


def decode(shards: Mapping[int, bytes], parity: Mapping[int, bytes], k: int) -> dict[int, bytes]:
    """Return the shards that are missing, computed from any ``k`` of all.

    Args:
        shards: those that are here, by their place below ``k``.
        parity: parity shards by index below ``PARITY_MAX``; as many as shards are missing are used.

    Raises:
        LocalError: bounds; or fewer than ``k`` in all.
    """
    missing = [place for place in range(k) if place not in shards]
    used = sorted(parity)[: len(missing)]
    if not missing:
        return {}
    present = [shards[place] for place in range(k) if place in shards] + [parity[index] for index in used]
    if len(present) < k or k > DATA_MAX or used[-1] >= PARITY_MAX or len({len(each) for each in present}) > 1:
        raise LocalError(f"{len(present)} shards for {k}, of one length each")
    # What the missing shards add to each used parity shard, then those shards themselves.
    sums = _multiply(
        [
            _picks([_coefficient(index, place) for place in range(k) if place in shards] + [index == at for at in used])
            for index in used
        ],
        present,
    )
    inverse = _inverse([[_coefficient(index, place) for place in missing] for index in used])
    rows = _multiply([_picks(row) for row in inverse], sums)
    return {place: row[: len(present[0])] for place, row in zip(missing, rows, strict=True)}


def _coefficient(index: int, place: int) -> int:
    return _EXP[_LOG[DATA_MAX ^ place] + 255 - _LOG[DATA_MAX + index ^ place]]


def _product(a: int, b: int) -> int:
    return _EXP[_LOG[a] + _LOG[b]] if a and b else 0


def _inverse(matrix: list[list[int]]) -> list[list[int]]:
    """Return the inverse of a square matrix that has one (Gauss-Jordan)."""
    size = len(matrix)
    rows = [row + [int(at == column) for column in range(size)] for at, row in enumerate(matrix)]
    for column in range(size):
        pivot = next(at for at in range(column, size) if rows[at][column])
        rows[column], rows[pivot] = rows[pivot], rows[column]
        factor = _EXP[255 - _LOG[rows[column][column]]]
        rows[column] = [_product(factor, value) for value in rows[column]]
        for at in range(size):
            if at != column and (factor := rows[at][column]):
                rows[at] = [a ^ _product(factor, b) for a, b in zip(rows[at], rows[column], strict=True)]
    return [row[size:] for row in rows]


@lru_cache(maxsize=1_024)
def _picks_of_parity(index: int, k: int) -> _Picks:
    return _picks([_coefficient(index, place) for place in range(k)])


def _picks(coefficients: Sequence[int]) -> _Picks:
    """Return which rows to add for each bit of the coefficients, and where each bit's rows begin.

    A row of zeros follows the shards: it is added for each bit, so that none is empty.
    """
    import numpy as np

    zeros = len(coefficients)
    of_bits = [[at for at, each in enumerate(coefficients) if each >> bit & 1] + [zeros] for bit in range(8)]
    begins = np.cumsum([0] + [len(each) for each in of_bits[:-1]])
    return np.array([at for each in of_bits for at in each]), begins


def _multiply(picks: Sequence[_Picks], shards: Sequence[bytes]) -> list[bytes]:
    """Return each row of coefficients times the shards; rows end with padding to a multiple of 8 bytes."""
    import numpy as np

    size = len(shards[0])
    width = -(-size // _WORD_BYTES) * _WORD_BYTES
    padding = bytes(width - size)
    rows = np.frombuffer(padding.join([*shards, bytes(width)]), np.uint64)
    rows = rows.reshape(len(shards) + 1, -1)
    sums = np.empty((len(picks), 8, width // _WORD_BYTES), np.uint64)
    for at, (picked, begins) in enumerate(picks):
        np.bitwise_xor.reduceat(rows[picked], begins, axis=0, out=sums[at])
    total: _Rows = sums[:, 7].copy()
    for bit in range(6, -1, -1):
        carried = total >> np.uint64(7) & np.uint64(_ONES)
        total = (total & np.uint64(_LOW_BITS)) << np.uint64(1) ^ carried * np.uint64(_REDUCTION) ^ sums[:, bit]
    return [row.tobytes() for row in total]
