"""Growth of a figure: the slope of samples by least squares.

Sans-I/O. A bounded figure rises while it warms up and is flat after that, so the samples of the warm-up are left out.
A slope is reported as growth over the rest of the run, with the spread of the samples around their line.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

__all__ = ["Growth", "growth_of"]

_WARM_UP: Final = 0.4  # share of the samples


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of a figure after the warm-up.

    Attributes:
        mean: of the samples.
        rise: rise of the line from its first sample to its last; negative where it falls.
        scatter: standard deviation of the samples from the line.
    """

    mean: float
    rise: float
    scatter: float

    def is_flat(self, share: float, least: float) -> bool:
        """Return whether the rise is below a share of the mean, below ``least``, or below the scatter."""
        return self.rise <= max(share * abs(self.mean), least, 2 * self.scatter)


def growth_of(samples: Sequence[float]) -> Growth:
    """Return the growth of the samples after the warm-up; they were taken at even distances.

    Raises:
        ValueError: too few samples.
    """
    kept = samples[int(len(samples) * _WARM_UP) :]
    if len(kept) < 3:
        raise ValueError(f"{len(samples)} samples are too few")
    places = range(len(kept))
    slope, start = statistics.linear_regression(places, kept)
    scatter = statistics.pstdev(value - (start + slope * at) for at, value in zip(places, kept, strict=True))
    return Growth(statistics.fmean(kept), slope * (len(kept) - 1), scatter)
