"""Pictures: bars of a bench, and histogram, CDF and timeline of an experiment's latencies.

I/O. PNG files. Needs matplotlib, the extra ``bench`` of this package, and no display. A whisker of a bar leads to the
p99 or spans the rounds.

    require_plot()                                       # at the start, so that a missing library is reported first
    panels_of(over, column, contenders)                  # a panel for each case; whiskers: lowest to highest round
    panels_of(over, median_column, contenders, p99=p99_column)        # whiskers: median to p99
    save_bars(path, "Forwarding", str(state), [
        Panel("1400 B, 3 switches", "frames/s", [Bar("kernel", 450e3, 440e3, 460e3), Bar("bridge", 244e3)]),
    ])
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from report import Rounds, number_text, percentile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from samples import Sample

COLOURS: Final = ("#99a8b2", "#1f6f8b", "#c96f3b", "#5b8c5a", "#7a5195")  # others, ours, ours again
_BAR_INCHES, _PANEL_INCHES, _WIDTH_INCHES, _PER_ROW = 0.3, 1.1, 6.0, 2
_DOTS_PER_INCH: Final = 110
_BINS: Final = 30


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar: its length, and where its whisker begins (None: at the median) and ends (None: no whisker)."""

    label: str
    median: float
    low: float | None = None
    high: float | None = None
    ours: bool = True

    @property
    def whisker(self) -> tuple[float, float]:
        """Return how far the whisker reaches below and above the median."""
        low, high = (self.median if end is None else end for end in (self.low, self.high))
        return self.median - low, high - self.median


@dataclass(frozen=True, slots=True)
class Panel:
    """Bars on one axis. ``unit`` is the label of the axis, and explains the whiskers."""

    title: str
    unit: str
    bars: Sequence[Bar]


def panels_of(
    over: Rounds, column: str, contenders: Sequence[str], *, p99: str | None = None, ours: Sequence[str] | None = None
) -> list[Panel]:
    """Return a panel of one column for each case that has it; baselines without a figure are left out.

    ``p99``: the column that whiskers lead to; without it they span the rounds. ``ours``: baselines to colour as ours;
    None: all of them.
    """
    unit = f"{column}; whiskers: {'to the p99' if p99 else 'lowest and highest round'}"
    panels = []
    for case in over.cases():
        bars = []
        for who in contenders:
            if spread := over.spread(who, case, column):
                tail = over.spread(who, case, p99) if p99 else None
                low, high = (None, tail.median if tail else None) if p99 else (spread.low, spread.high)
                bars.append(Bar(who, spread.median, low, high, ours is None or who in ours))
        if bars:
            panels.append(Panel(case, unit, bars))
    return panels


def require_plot() -> None:
    """Exit with a clear message if matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        sys.exit("no matplotlib for the plot: pip install 'gdp-ros[bench]' (or go without: --no-plot)")


def pyplot() -> Any:
    """Return the library that draws, without a display; exits with a clear message if it is missing."""
    require_plot()
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def save(figure: Figure, path: Path, title: str = "", footer: str = "") -> None:
    """Write a figure to a PNG file, and close it."""
    if title:
        figure.suptitle(title, fontsize=12)
    if footer:
        figure.supxlabel(footer, fontsize=7, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
    pyplot().close(figure)


def tidy(axis: Axes, *, has_legend: bool = True) -> None:
    """Give an axis small labels, no lines above and to the right, and a legend without a frame."""
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    if has_legend:
        axis.legend(fontsize=8, frameon=False)


def save_bars(path: Path, title: str, footer: str, panels: Sequence[Panel]) -> None:
    """Draw the panels that have bars, two a row, into a PNG file."""
    drawn = [panel for panel in panels if panel.bars]
    if not drawn:
        sys.exit(f"{path}: nothing was measured, so there is nothing to draw")
    columns = min(_PER_ROW, len(drawn))
    rows = [drawn[at : at + columns] for at in range(0, len(drawn), columns)]
    heights = [max(len(panel.bars) for panel in row) * _BAR_INCHES + _PANEL_INCHES for row in rows]
    figure, axes = pyplot().subplots(
        len(rows),
        columns,
        figsize=(_WIDTH_INCHES * columns, sum(heights) + 0.8),
        squeeze=False,
        gridspec_kw={"height_ratios": heights},
        layout="constrained",
    )
    for axis in axes.flat[len(drawn) :]:
        axis.set_visible(False)
    for axis, panel in zip(axes.flat, drawn, strict=False):
        _draw(axis, panel)
    save(figure, path, f"{title}\n", footer)


def _draw(axis: Axes, panel: Panel) -> None:
    bars = panel.bars
    whiskers = list(zip(*(bar.whisker for bar in bars), strict=True))
    style = {"ecolor": "#222222", "capsize": 2.5, "lw": 0.9}
    colours = [COLOURS[bar.ours] for bar in bars]
    drawn = axis.barh(
        range(len(bars)), [bar.median for bar in bars], 0.66, color=colours, xerr=whiskers, error_kw=style
    )
    axis.bar_label(drawn, [number_text(bar.median) for bar in bars], padding=4, fontsize=8)
    axis.set_yticks(range(len(bars)), [bar.label for bar in bars], fontsize=8)
    axis.locator_params(axis="x", nbins=5)
    axis.xaxis.set_major_formatter("{x:,.10g}")
    axis.margins(x=0.16)
    axis.invert_yaxis()
    axis.set_title(panel.title, fontsize=10, loc="left")
    axis.set_xlabel(panel.unit, fontsize=8)
    tidy(axis, has_legend=False)


def save_distributions(path: Path, title: str, panels: Mapping[str, Mapping[str, Sequence[float]]], unit: str) -> None:
    """Draw a histogram and a CDF for each panel: series by label, in ``unit``; dashed: the p99."""
    size = (11, 2.9 * len(panels))
    figure, rows = pyplot().subplots(len(panels), 2, figsize=size, squeeze=False, layout="constrained")
    for (name, series), (left, right) in zip(panels.items(), rows, strict=True):
        highest = max(max(values) for values in series.values())
        for (label, values), colour in zip(series.items(), COLOURS, strict=False):
            left.hist(values, bins=_BINS, range=(0, highest), alpha=0.6, color=colour, label=label)
            ordered = sorted(values)
            shares = [(at + 1) / len(ordered) for at in range(len(ordered))]
            right.step([0, *ordered], [0, *shares], where="post", color=colour, label=label)
            right.axvline(percentile(ordered, 0.99), color=colour, ls="--", lw=0.8)
        left.set_title(f"{name}: how many", fontsize=10, loc="left")
        right.set_title(f"{name}: share that took at most so long; dashed: p99", fontsize=10, loc="left")
        for axis in (left, right):
            axis.set_xlabel(unit, fontsize=8)
            tidy(axis)
    save(figure, path, title)


@dataclass(frozen=True, slots=True)
class Span:
    """Interval in which a machine was away, in seconds of the timeline."""

    machine: str
    from_s: float
    to_s: float


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
    figure, axis = pyplot().subplots(figsize=(11, 3.6), layout="constrained")
    machines = sorted({each.machine for each in samples if each.is_right} | {span.machine for span in spans})
    colours = dict(zip(machines, cycle(COLOURS[1:]), strict=False))
    for machine in machines:
        of = [each for each in samples if each.machine == machine and each.is_right]
        times, latencies = [each.begun_s - from_s for each in of], [1e3 * each.latency_s for each in of]
        axis.scatter(times, latencies, s=5, color=colours[machine], label=f"answered by {machine}")
    for span in spans:
        axis.axvspan(span.from_s, span.to_s, color=colours[span.machine], alpha=0.15, lw=0)
    for moved_s in moves:
        axis.axvline(moved_s, color="black", ls=":", lw=0.8)
    failed = [(each.begun_s - from_s, 1e3 * each.latency_s) for each in samples if not each.is_right]
    axis.scatter(*([one[at] for one in failed] for at in (0, 1)), s=24, color="red")
    axis.set_xlabel("seconds; shaded: the machine of that colour was killed and is not serving yet", fontsize=8)
    axis.set_ylabel("latency, ms", fontsize=8)
    axis.set_ylim(bottom=0)
    tidy(axis)
    save(figure, path, title)
