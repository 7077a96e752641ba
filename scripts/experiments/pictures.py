"""Pictures of the experiments: histogram and CDF of latencies, and latencies over time.

I/O. PNG files. Needs matplotlib, and no display.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Final

import matplotlib as mpl

mpl.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from samples import Sample, p99

__all__ = ["Span", "plt", "save", "save_distributions", "save_timeline"]

_COLOURS: Final = ("#99a8b2", "#1f6f8b", "#c96f3b", "#5b8c5a", "#7a5195")
_DOTS_PER_INCH: Final = 110
_BINS: Final = 30


@dataclass(frozen=True, slots=True)
class Span:
    """Interval in which a machine was away, in seconds of the timeline."""

    machine: str
    from_s: float
    to_s: float


def save_distributions(path: Path, title: str, panels: Mapping[str, Mapping[str, Sequence[float]]], unit: str) -> None:
    """Draw a histogram and a CDF for each panel: series by label, in ``unit``; dashed: the p99."""
    figure, rows = plt.subplots(len(panels), 2, figsize=(11, 2.9 * len(panels)), squeeze=False, layout="constrained")
    for (name, series), (left, right) in zip(panels.items(), rows, strict=True):
        highest = max(max(values) for values in series.values())
        for (label, values), colour in zip(series.items(), _COLOURS, strict=False):
            left.hist(values, bins=_BINS, range=(0, highest), alpha=0.6, color=colour, label=label)
            ordered = sorted(values)
            shares = [(at + 1) / len(ordered) for at in range(len(ordered))]
            right.step([0, *ordered], [0, *shares], where="post", color=colour, label=label)
            right.axvline(p99(ordered), color=colour, ls="--", lw=0.8)
        left.set_title(f"{name}: how many", fontsize=10, loc="left")
        right.set_title(f"{name}: share that took at most so long; dashed: p99", fontsize=10, loc="left")
        for axis in (left, right):
            axis.set_xlabel(unit, fontsize=8)
            _tidy(axis)
    save(figure, path, title)


def save_timeline(
    path: Path,
    title: str,
    samples: Sequence[Sample],
    spans: Sequence[Span],
    from_s: float,
    moves: Sequence[float] = (),
) -> None:
    """Draw each request as a point, coloured by the machine that answered; grey: a machine was away; red: failed.

    ``moves``: seconds of the timeline, each a dotted line.
    """
    figure, axis = plt.subplots(figsize=(11, 3.6), layout="constrained")
    machines = sorted({each.machine for each in samples if each.is_right} | {span.machine for span in spans})
    colours = dict(zip(machines, cycle(_COLOURS[1:]), strict=False))
    for machine in machines:
        of = [each for each in samples if each.machine == machine and each.is_right]
        times, latencies = [each.begun_s - from_s for each in of], [1e3 * each.latency_s for each in of]
        axis.scatter(times, latencies, s=5, color=colours[machine], label=f"answered by {machine}")
    for span in spans:
        axis.axvspan(span.from_s, span.to_s, color=colours[span.machine], alpha=0.15, lw=0)
    for moved_s in moves:
        axis.axvline(moved_s, color="black", ls=":", lw=0.8)
    failed = [each for each in samples if not each.is_right]
    axis.scatter(
        [each.begun_s - from_s for each in failed], [1e3 * each.latency_s for each in failed], s=24, color="red"
    )
    axis.set_xlabel("seconds; shaded: the machine of that colour was killed and is not serving yet", fontsize=8)
    axis.set_ylabel("latency, ms", fontsize=8)
    axis.set_ylim(bottom=0)
    _tidy(axis)
    save(figure, path, title)


def _tidy(axis: Axes) -> None:
    """Give an axis small labels, a legend without a frame, and no lines above and to the right."""
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=8, frameon=False)


def save(figure: Figure, path: Path, title: str = "") -> None:
    """Write a figure to a PNG file, and close it."""
    if title:
        figure.suptitle(title, fontsize=12)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
    plt.close(figure)
