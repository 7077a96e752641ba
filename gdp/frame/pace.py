"""Paces: classes of a path's rate, of which a frame states one (``spec.md``).

Sans-I/O. From 1 kB/s on there are four in each doubling of the rate; ``PACE_MAX`` stands for every rate.
"""

from __future__ import annotations

from math import log2
from typing import Final

from gdp.limits import PACE_MAX

_LEAST: Final = 1_000  # bytes a second
_STEPS: Final = 4


def pace_of(bytes_s: float) -> int:
    """Return the pace of a path that carries ``bytes_s``."""
    return min(max(round(_STEPS * log2(max(bytes_s, 1.0) / _LEAST)), 1), PACE_MAX - 1)


def kbit_s_of(pace: int) -> int | None:
    """Return the rate of a pace in kbit/s, to three digits; None: every frame passes."""
    return None if pace == PACE_MAX else int(float(f"{8e-3 * _LEAST * 2 ** (pace / _STEPS):.3g}"))
