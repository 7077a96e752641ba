"""Waits of servers that compute nothing, drawn from recorded runs of planners and of a network.

Sans-I/O, but for reading the recordings. Of a run of a planner there is the number of states that it checked, by
problem, with the planner's name. The number is proportional to the time of the run on an idle machine. A run that had
no path after ``MOST_CHECKS`` was stopped there, and counts as the paper's timeout. Of a run of DBNet there is the
processor time. ``git show 55cf6b3c:scripts/experiments/record.py`` is the program that recorded them.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Final

from samples import least_of_two, p99

RECORDING: Final = Path(__file__).with_name("planning_runs.json")
SEGMENTATION: Final = Path(__file__).with_name("segmentation_runs.json")
LIMIT_S: Final = 100.0  # the paper's timeout
_CHECKS_A_SECOND: Final = 85_000  # of RRTConnect in Cubicles on an idle core (AMD EPYC)
MOST_CHECKS: Final = int(LIMIT_S * _CHECKS_A_SECOND)
# Factor by which the waits are shorter than the runs, so that a hundred trials take minutes.
FASTER: Final[Mapping[str, float]] = {"Home": 20.0, "Cubicles": 1.0, "Twistycool": 40.0}


@dataclass(frozen=True, slots=True)
class Recorded:
    """Runs of a problem, in seconds, as on an idle machine."""

    planner: str
    runs_s: list[float]

    def gains(self) -> tuple[float, float]:
        """Return what the least of any two runs gains over one: in the mean, and in the p99."""
        least = least_of_two(self.runs_s)
        return fmean(self.runs_s) / fmean(least), p99(self.runs_s) / p99(least)


def load(path: Path = RECORDING) -> dict[str, Recorded]:
    """Return the recorded runs by problem."""
    recording = json.loads(path.read_text(encoding="utf-8"))
    return {
        name: Recorded(each["planner"], [checks / _CHECKS_A_SECOND for checks in each["checks"]])
        for name, each in recording.items()
    }


def segmentation_runs() -> list[float]:
    """Return the processor time of each recorded run of DBNet, in seconds."""
    return [float(seconds) for seconds in json.loads(SEGMENTATION.read_text(encoding="utf-8"))]


def draw(runs: list[float], faster: float, count: int, chance: random.Random) -> list[float]:
    """Return waits: runs drawn with replacement, and shortened."""
    return [chance.choice(runs) / faster for _ in range(count)]
