"""Picture of a bench: horizontal bars of medians, with a whisker up to the p99 or over the spread of the rounds.

I/O. One file. Needs matplotlib, the extra ``bench`` of this package, and no display.

    require_plot()                                       # at the start, so that a missing library is reported first
    save_bars(path, "Forwarding", str(state), [
        Panel("1400 B, 3 switches", "frames/s", [Bar("kernel", 450e3, 440e3, 460e3), Bar("bridge", 244e3)]),
        Panel("100 B", "round trip, µs: median, whisker to p99", [Bar("kernel", 4.7, None, 12.0)], log=True),
    ])
    panel_of(over, case, column, contenders)             # whiskers: lowest to highest round
    panel_of(over, case, median_column, contenders, p99=p99_column)   # whiskers: median to p99

Several bars of one baseline (sizes, encodings) are bars with a label each, in one panel or in panels side by side.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from report import Rounds, number_text

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


@dataclass(frozen=True, slots=True)
class Panel:
    """Bars on one axis. ``unit`` is the label of the axis, and explains the whiskers."""

    title: str
    unit: str
    bars: Sequence[Bar]
    log: bool = False


def panel_of(
    over: Rounds,
    case: str,
    column: str,
    contenders: Sequence[str],
    *,
    title: str | None = None,
    p99: str | None = None,
    ours: Sequence[str] = (),
    log: bool = False,
) -> Panel:
    """Return the panel of one column of one case; baselines without a figure are left out.

    ``p99``: the column that whiskers lead to; without it they span the rounds. ``ours``: baselines to colour as ours.
    """
    bars = []
    for contender in contenders:
        spread = over.spread(contender, case, column)
        if spread is None:
            continue
        tail = over.spread(contender, case, p99) if p99 else None
        low, high = (None, tail.median if tail else None) if p99 else (spread.low, spread.high)
        bars.append(Bar(contender, spread.median, low, high, contender in ours))
    whiskers = "whiskers: to the p99" if p99 else "whiskers: lowest and highest round"
    return Panel(title or case, f"{column}; {whiskers}", bars, log)


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
    for row, line in zip(rows, axes, strict=True):
        for at, axis in enumerate(line):
            if at >= len(row):
                axis.set_visible(False)
                continue
            panel, places = row[at], range(len(row[at].bars))
            medians = [bar.median for bar in panel.bars]
            axis.barh(places, medians, 0.66, color=[_COLOURS[not bar.ours] for bar in panel.bars])
            below = [bar.median - (bar.median if bar.low is None else bar.low) for bar in panel.bars]
            upstream = [(bar.median if bar.high is None else bar.high) - bar.median for bar in panel.bars]
            axis.errorbar(medians, places, xerr=[below, upstream], fmt="none", ecolor="#222222", capsize=2.5, lw=0.9)
            for place, bar in zip(places, panel.bars, strict=True):
                end = max(bar.median, bar.high or 0.0)
                axis.annotate(
                    number_text(bar.median), (end, place), (4, 0), textcoords="offset points", va="center", fontsize=8
                )
            if panel.log:
                axis.set_xscale("log")
                axis.xaxis.set_minor_formatter("")
            else:
                axis.locator_params(axis="x", nbins=5)
            axis.xaxis.set_major_formatter("{x:,.10g}")
            axis.margins(x=0.16)
            axis.set_yticks(places, [bar.label for bar in panel.bars], fontsize=8)
            axis.invert_yaxis()
            axis.set_title(panel.title, fontsize=10, loc="left")
            axis.set_xlabel(panel.unit, fontsize=8)
            axis.tick_params(axis="x", labelsize=8)
            axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{title}\n", fontsize=12)
    figure.supxlabel(footer, fontsize=7, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
    plt.close(figure)
