"""Waits of servers that compute nothing, drawn from recorded runs of planners and of a network.

Sans-I/O, but for reading the recordings. Each run of ``RRTConnect`` is a pair. ``record.py`` writes the number of
states that the run checked, and its processor time. The number is proportional to the time of the run on an idle
machine. Where the number is 0 it was not counted: the second number is then the time on such a machine (the computed
trials of figure 5). Of a run of DBNet there is only the processor time (``record_segmentation.py``).
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Final

__all__ = ["LIMIT_S", "RECORDED", "RECORDING", "SEGMENTATION", "Recorded", "draw", "load", "segmentation_runs"]

RECORDING: Final = Path(__file__).with_name("planning_runs.json")
SEGMENTATION: Final = Path(__file__).with_name("segmentation_runs.json")
LIMIT_S: Final = 100.0  # the paper's timeout


@dataclass(frozen=True, slots=True)
class Recorded:
    """Use of the runs of a problem.

    Args:
        mean_s: of the computed trials of figure 5 on an idle machine; the recorded runs are scaled to it.
        faster: factor by which the waits are shorter than the runs, so that a hundred trials take minutes.
    """

    mean_s: float
    faster: float


RECORDED: Final[Mapping[str, Recorded]] = {
    "Home": Recorded(4.21, 20.0),
    "Cubicles": Recorded(0.247, 1.0),
    "Twistycool": Recorded(13.4, 40.0),
}


def load(path: Path = RECORDING) -> dict[str, list[float]]:
    """Return the recorded runs by problem, in seconds, as on an idle machine; at most ``LIMIT_S`` each."""
    recording: dict[str, list[list[float]]] = json.loads(path.read_text(encoding="utf-8"))
    found = {}
    for name, runs in recording.items():
        counted = [checks for checks, _ in runs if checks]
        scale = RECORDED[name].mean_s / fmean(counted) if counted else 0.0
        found[name] = [min(scale * checks if checks else seconds, LIMIT_S) for checks, seconds in runs]
    return found


def segmentation_runs() -> list[float]:
    """Return the processor time of each recorded run of DBNet, in seconds."""
    return [float(seconds) for seconds in json.loads(SEGMENTATION.read_text(encoding="utf-8"))]


def draw(runs: list[float], faster: float, count: int, chance: random.Random) -> list[float]:
    """Return waits: runs drawn with replacement, and shortened."""
    return [chance.choice(runs) / faster for _ in range(count)]
