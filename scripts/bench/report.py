"""Common report of the benches: figures over rounds, tables, ratios with targets, JSON, and a line on the machine.

Sans-I/O, but for ``show`` (prints), ``progress`` (stderr) and ``write_json`` (one file). ``machine.py``
describes the machine, ``plot.py`` draws the picture. Scripts of this folder import it by its bare name: ``from report
import``.

    state = machine_state()                                          # machine.py, before anything else
    over = Rounds()                                                  # figures, by what and by whom
    for number in range(rounds):                                     # baselines interleaved: A B C, A B C ...
        for baseline in baselines:
            progress(f"round {number + 1}/{rounds}: {baseline}")
            over.add(baseline, "1400 B, 3 switches", "frames/s", 450_000.0)      # None: it could not be measured
    over.spread("kernel", "1400 B, 3 switches", "frames/s")          # Spread(median, low, high) | None
    target = over.ratio("kernel / bridge, frames/s", "kernel", "bridge", "1400 B, 3 switches", "frames/s", 1.3)
    show(title, state, settings, over, [target, ...])                  # tables, ratio lines
    write_json(path, "forwarding", state, settings, over, [target, ...])
    save_bars(path, ...)                                             # plot.py

A ratio is taken in each round and then medianed, so that what slows a whole round slows both of its sides. A figure of
one round is itself a median (or p99) over many frames; the name of its column states that.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from machine import MachineState
from rich.console import Console
from rich.table import Table

Settings = Mapping[str, str | int | float | bool | Sequence[int] | Sequence[str]]
_CONSOLE_COLUMNS = 165


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over rounds: its median, lowest and highest value."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of one value or more. Raises ``ValueError``: none at all."""
        return cls(statistics.median(values), min(values), max(values))

    def __str__(self) -> str:
        if self.low == self.high:
            return number_text(self.median)
        return f"{number_text(self.median)} ({number_text(self.low)}-{number_text(self.high)})"


@dataclass(frozen=True, slots=True)
class Target:
    """Figure with a bound, and its measured values.

    Attributes:
        what: the figure in words, with its unit unless it is a ratio.
        target: the bound; None where there is none.
        at_most: the bound is an upper one.
        measured: over rounds; None when a side of it could not be measured.
        why_not: then, the reason.
    """

    what: str
    target: float | None
    at_most: bool
    measured: Spread | None
    why_not: str = ""

    @property
    def met(self) -> bool | None:
        """Return whether the median keeps the bound; None when there is none, or nothing was measured."""
        if self.measured is None or self.target is None:
            return None
        return self.measured.median <= self.target if self.at_most else self.measured.median >= self.target

    def __str__(self) -> str:
        measured = f"measured {self.measured}" if self.measured else f"not measured: {self.why_not}"
        if self.target is None:
            return f"{self.what}: {measured}"
        target = f"target {'≤' if self.at_most else '≥'} {number_text(self.target)}"
        if self.measured is None:
            return f"{self.what}: {target}, {measured}"
        return f"{self.what}: {target}, {measured}, {'met' if self.met else 'MISSED'}"


@dataclass(slots=True)
class Rounds:
    """Figures of a bench: baseline, case, column (figure and unit), one value a round."""

    values: dict[str, dict[str, dict[str, list[float | None]]]] = field(default_factory=dict)

    def add(self, contender: str, case: str, column: str, value: float | None) -> None:
        """Add the value of the next round; None for one that failed."""
        self.values.setdefault(contender, {}).setdefault(case, {}).setdefault(column, []).append(value)

    def column(self, contender: str, case: str, column: str) -> list[float | None]:
        """Return one value a round."""
        return self.values.get(contender, {}).get(case, {}).get(column, [])

    def spread(self, contender: str, case: str, column: str) -> Spread | None:
        """Return a figure over the rounds that measured it; None when none did."""
        known = [value for value in self.column(contender, case, column) if value is not None]
        return Spread.of(known) if known else None

    def cases(self) -> list[str]:
        """Return the cases in their first order."""
        return list(dict.fromkeys(case for cases in self.values.values() for case in cases))

    def columns(self, case: str) -> list[str]:
        """Return the columns that any baseline has in a case."""
        return list(dict.fromkeys(column for cases in self.values.values() for column in cases.get(case, {})))

    def target(
        self, what: str, contender: str, case: str, column: str, asked: float | None, *, at_most: bool = False
    ) -> Target:
        """Return a bound on one baseline's figure."""
        return _target(what, asked, at_most, self.column(contender, case, column), self._why_not(contender, case))

    def ratio(
        self, what: str, one: str, other: str, case: str, column: str, asked: float | None, *, at_most: bool = False
    ) -> Target:
        """Return a bound on ``one / other``, round by round."""
        values = self._pairwise(one, other, case, column, lambda a, b: a / b if b else None)
        return _target(what, asked, at_most, values, self._why_not(one, case) or self._why_not(other, case))

    def difference(self, what: str, one: str, other: str, case: str, column: str, asked: float | None) -> Target:
        """Return an upper bound on ``one - other``, round by round."""
        values = self._pairwise(one, other, case, column, lambda a, b: a - b)
        return _target(what, asked, True, values, self._why_not(one, case) or self._why_not(other, case))

    def _pairwise(
        self, one: str, other: str, case: str, column: str, of: Callable[[float, float], float | None]
    ) -> list[float | None]:
        pairs = zip(self.column(one, case, column), self.column(other, case, column), strict=False)
        return [None if a is None or b is None else of(a, b) for a, b in pairs]

    def _why_not(self, contender: str, case: str) -> str:
        return "" if case in self.values.get(contender, {}) else f"{contender} was not asked for"


def _target(what: str, asked: float | None, at_most: bool, values: Iterable[float | None], why_not: str) -> Target:
    known = [value for value in values if value is not None]
    if known:
        return Target(what, asked, at_most, Spread.of(known))
    return Target(what, asked, at_most, None, why_not or "no round measured it")


def percentile(values: Iterable[float], share: float) -> float:
    """Return the smallest value that at least ``share`` (0 to 1) of the values do not exceed.

    Raises ``ValueError``: no values.
    """
    ordered = sorted(values)
    if not ordered:
        raise ValueError("no values")
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def number_text(value: float) -> str:
    """Return a figure with about three significant digits."""
    size = abs(value)
    if size >= 1_000:
        return f"{value:,.0f}"
    if size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 or not size else f"{value:.2g}"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """Return a table in Markdown; the last ``numbers`` columns are aligned to the right."""
    rule = ["---"] * (len(head) - numbers) + ["--:"] * numbers
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, rule, *rows])


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, title: str = "", words: int = 1) -> None:
    """Print a table whose first ``words`` columns are words, and all others figures."""
    table = Table(title=title or None, title_justify="left")
    for at, heading in enumerate(head):
        table.add_column(heading, justify="left" if at < words else "right", no_wrap=words == 1 and at == 0)
    for row in rows:
        table.add_row(*row)
    _console().print(table)


def _console() -> Console:
    return Console() if sys.stdout.isatty() else Console(width=_CONSOLE_COLUMNS)


def progress(text: str) -> None:
    """Report progress on stderr, so that stdout holds results alone."""
    print(text, file=sys.stderr, flush=True)


def show(title: str, state: MachineState, settings: Settings, over: Rounds, targets: Sequence[Target] = ()) -> None:
    """Print the machine, a table a case, and a line for each figure with a target."""
    console = _console()
    console.print(f"[bold]{title}[/bold]\n{state}", highlight=False)
    console.print(
        "; ".join(f"{key}: {_setting_text(value)}" for key, value in settings.items()), highlight=False, soft_wrap=True
    )
    for case in over.cases():
        columns, rows = over.columns(case), []
        for contender, cases in over.values.items():
            if case in cases:
                spreads = (over.spread(contender, case, column) for column in columns)
                rows.append((contender + state.mark, *("-" if spread is None else str(spread) for spread in spreads)))
        print_table(("", *columns), rows, title=case)
    for target in targets:
        console.print(str(target), markup=False, highlight=False, soft_wrap=True)


def _setting_text(value: str | float | Sequence[int] | Sequence[str]) -> str:
    return str(value) if isinstance(value, str | int | float) else ", ".join(map(str, value))


def write_json(
    path: Path,
    bench: str,
    state: MachineState,
    settings: Settings,
    over: Rounds,
    targets: Sequence[Target] = (),
    *,
    keeps: bool = False,
) -> None:
    """Write all values of all rounds, the targets with their results, and day, commit and load of each row.

    ``keeps``: rows and targets that the file has and this run has not are kept.
    """
    held = json.loads(path.read_text(encoding="utf-8")) if keeps and path.exists() else {"rounds": {}, "targets": []}
    new = {target.what for target in targets}
    stamp = {"date": state.date, "commit": state.commit, "load_before": state.load_before}
    answer = {
        "bench": bench,
        "machine": asdict(state),
        "settings": dict(settings),
        "rounds": {**held["rounds"], **over.values},
        "measured": {**held.get("measured", {}), **dict.fromkeys(over.values, stamp)},
        "targets": [
            *(target for target in held["targets"] if target["what"] not in new),
            *({**asdict(target), "met": target.met} for target in targets),
        ],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")
