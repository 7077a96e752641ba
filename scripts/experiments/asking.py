"""Series of calls in progress at the robot, read a sample at a time.

I/O. Starts ``robot.py`` at a place, and reads what it prints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Final

import bench_path  # noqa: F401 - finds ``peers``
from report import progress
from samples import Sample, Series

from gdp.closing import ClosedOnExit
from lab.process import LabProcess

_ROBOT: Final = "robot"
_BEGIN_S: Final = 90.0
_SILENT_S: Final = 20.0  # silence of a client between two samples


class Asking(ClosedOnExit):
    """Series in progress, read a sample at a time; a context manager that ends its client.

    ``start``: starts a role of ``robot.py`` at a machine: ``client`` of a ``Field`` or a ``TagCluster``. ``twice``:
    surplus answers that reached a call; None until the end, or where they were not counted. ``heard``: answers in all;
    the same. ``warm_up``: calls of each service before the series.
    """

    def __init__(self, start: Callable[..., LabProcess], series: Series) -> None:
        self._series = series
        self._client = start(_ROBOT, "ask", **asdict(series))
        self.twice: int | None = None
        self.heard: int | None = None
        self.warm_up: dict[str, int] = {}

    def close(self) -> None:
        """End the client."""
        self._client.close()

    def __iter__(self) -> Iterator[Sample]:
        """Yield each sample as it comes; raises FailedError if none comes in time."""
        self.warm_up = self._client.read(_BEGIN_S)["warm_up"]
        while "sample" in (said := self._client.read(max(2 * self._series.patience_s, _SILENT_S))):
            yield Sample(**said["sample"])
        self.twice, self.heard = said["twice"], said["heard"]

    def by_service(self, what: str) -> dict[str, list[Sample]]:
        """Return all samples of each service, and report progress at intervals."""
        found: dict[str, list[Sample]] = {}
        for number, sample in enumerate(self, 1):
            found.setdefault(sample.service, []).append(sample)
            if number % max(self._series.count // 5, 1) == 0:
                progress(f"{what}: {number} of {self._series.count}")
        return found
