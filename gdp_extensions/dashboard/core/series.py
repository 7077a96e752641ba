"""History of figures: one sample each poll for fifteen minutes, 4 bytes each.

Sans-I/O. A series exists from its first sample other than zero, so that thousands of idle names take no memory.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Final

SAMPLES: Final = 1_200  # one each ``server.POLL_S``
SERIES_MAX: Final = 8_192  # 39 MB


class SeriesStore:
    """Series by key, all sampled at the same moments; ``refused``: keys that found no space in the last step."""

    def __init__(self, samples: int = SAMPLES) -> None:
        self._samples = samples
        self._at = -1  # slot of the newest sample
        self._taken = 0
        self._rows: dict[str, array[float]] = {}
        self.refused = 0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, figures: Mapping[str, float]) -> None:
        """Add a sample to each series; a series that is not named gets zero, and is dropped when all of it is."""
        self._at = (self._at + 1) % self._samples
        self._taken = min(self._taken + 1, self._samples)
        self.refused = 0
        for key, row in list(self._rows.items()):
            row[self._at] = figures.get(key, 0.0)
            if self._at == 0 and not any(row):
                del self._rows[key]
        for key, figure in figures.items():
            if figure and key not in self._rows:
                if len(self._rows) >= SERIES_MAX:
                    self.refused += 1
                    continue
                row = self._rows[key] = array("f", bytes(4 * self._samples))
                row[self._at] = figure

    def samples(self, key: str) -> list[float]:
        """Return the samples of a key so far, the oldest first; zeros for a series that does not exist."""
        row = self._rows.get(key)
        if row is None:
            return [0.0] * self._taken
        ordered = [*row[self._at + 1 :], *row[: self._at + 1]]
        return [round(each, 3) for each in ordered[self._samples - self._taken :]]
