"""Picture of a bench: horizontal bars of medians, with a whisker up to the p99 or over the spread of the rounds.

I/O. One file. Needs matplotlib, the extra ``bench`` of this package, and no display.

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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from report import Rounds, number_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = ("#1f6f8b", "#99a8b2")  # ours, the others
_BAR_INCHES, _PANEL_INCHES, _WIDTH_INCHES, _PER_ROW = 0.3, 1.1, 6.0, 2
_DOTS_PER_INCH = 110


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


def save_bars(path: Path, title: str, footer: str, panels: Sequence[Panel]) -> None:
    """Draw the panels that have bars, two a row, into a PNG file."""
    require_plot()
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    drawn = [panel for panel in panels if panel.bars]
    if not drawn:
        sys.exit(f"{path}: nothing was measured, so there is nothing to draw")
    columns = min(_PER_ROW, len(drawn))
    rows = [drawn[at : at + columns] for at in range(0, len(drawn), columns)]
    heights = [max(len(panel.bars) for panel in row) * _BAR_INCHES + _PANEL_INCHES for row in rows]
    figure, axes = plt.subplots(
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
    figure.suptitle(f"{title}\n", fontsize=12)
    figure.supxlabel(footer, fontsize=7, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
    plt.close(figure)


def _draw(axis: Axes, panel: Panel) -> None:
    bars = panel.bars
    whiskers = list(zip(*(bar.whisker for bar in bars), strict=True))
    style = {"ecolor": "#222222", "capsize": 2.5, "lw": 0.9}
    colours = [_COLOURS[not bar.ours] for bar in bars]
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
    axis.tick_params(axis="x", labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
