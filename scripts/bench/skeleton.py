"""Bench skeleton: command line, rounds, interruption, machine facts, table, JSON record and picture of every bench.

I/O. ``report.py`` defines figures, their spread and targets. A bench states its options and measures::

    def measure(options: Options) -> Outcome: ...

    if __name__ == "__main__":
        run_bench(command_line(__doc__, rounds=5, seconds=10.0, quick={"rounds": 1, "seconds": 1.0}), measure)
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from machine import ROOT, MachineState, RefusedError, calibration, machine_state, require_trust, require_writable
from plot import Panel, require_plot, save_bars
from report import Rounds, Settings, Target, progress, show, write_json

from gdp.burst import VARIANT
from gdp.errors import GdpError
from gdp.host.run_registry import RunRegistry
from lab.process import FailedError

OUTPUT: Final = ROOT / "docs" / "benchmarks"

Options = argparse.Namespace


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a bench.

    Attributes:
        name: of the record, and of its files below ``docs/benchmarks``.
        panels: of the picture.
        keeps_rows: rows of an earlier record that were not measured now are kept.
        has_failed: ends the command with 1.
    """

    name: str
    title: str
    rounds: Rounds
    targets: Sequence[Target]
    settings: Settings
    panels: Sequence[Panel] = ()
    keeps_rows: bool = False
    has_failed: bool = False


@dataclass(frozen=True, slots=True)
class Trial:
    """One measurement of a round; ``measure`` takes the round's number, from 1, and returns a figure a column."""

    case: str
    baseline: str
    columns: Sequence[str]
    measure: Callable[[int], Mapping[str, float]]


@dataclass(slots=True)
class Recorder:
    """Figures of the trials so far, and a note on each trial that failed."""

    rounds: Rounds = field(default_factory=Rounds)
    notes: list[str] = field(default_factory=list)

    def attempt(self, trial: Trial, number: int, total: int) -> Mapping[str, float]:
        """Measure one trial; a failure is noted and leaves its columns without a figure in this round."""
        where = f"round {number}/{total}, {trial.case}: {trial.baseline}"
        progress(where)
        found: Mapping[str, float] = {}
        try:
            found = trial.measure(number)
        except FailedError as error:
            progress(f"FAILED: {error}")
            self.notes.append(f"{where}: {error}")
        for column in trial.columns:
            self.rounds.add(trial.baseline, trial.case, column, found.get(column))
        return found

    def interleave(self, trials: Sequence[Trial], total: int) -> None:
        """Measure every trial once a round, so that what slows a round slows all of them."""
        for number in range(1, total + 1):
            for trial in trials:
                self.attempt(trial, number, total)


def command_line(
    description: str | None,
    *,
    rounds: int | None = None,
    seconds: float | None = None,
    seconds_of: str = "of each figure",
    quick: Mapping[str, float] | None = None,
    has_record: bool = False,
    has_plot: bool = False,
) -> argparse.ArgumentParser:
    """Return a parser with the options that benches share.

    Args:
        description: the bench's docstring.
        rounds: default of ``--rounds``; None: no such option.
        seconds: default of ``--seconds``; None: no such option.
        quick: what ``--quick`` sets; None: no such option.
        has_record: adds ``--json``, ``--no-save`` and ``--allow-load``.
        has_plot: adds ``--no-plot``.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if rounds is not None:
        parser.add_argument("--rounds", type=int, default=rounds, help="(default: %(default)s)")
    if seconds is not None:
        parser.add_argument("--seconds", type=float, default=seconds, help=f"{seconds_of} (default: %(default)s)")
    if quick is not None:
        text = ", ".join(f"{name} {value:g}" for name, value in quick.items())
        parser.add_argument("--quick", action="store_true", help=f"a short run that writes no page: {text}")
        parser.set_defaults(quick_values=quick)
    if has_record:
        parser.add_argument("--json", type=Path, help="where the figures go (default: docs/benchmarks)")
        parser.add_argument("--no-save", action="store_true", help="print only")
        add_allow_load(parser)
    if has_plot:
        parser.add_argument("--no-plot", action="store_true", help="no picture")
    return parser


def add_allow_load(parser: argparse.ArgumentParser) -> None:
    """Add ``--allow-load``."""
    text = "write the page also while the machine does other work, and mark each row with its load"
    parser.add_argument("--allow-load", action="store_true", help=text)


def parse(parser: argparse.ArgumentParser, words: Sequence[str] | None = None) -> Options:
    """Return the options, with those of ``--quick`` applied; ``words`` as ``sys.argv[1:]``."""
    options = parser.parse_args(words)
    if getattr(options, "quick", False) and hasattr(options, "quick_values"):
        vars(options).update(options.quick_values)
    return options


@contextmanager
def clean_exit() -> Iterator[None]:
    """End the command with one line on an expected error, and let SIGTERM and Ctrl-C remove what was made.

    The exit status is 2 where a precondition does not hold, and 1 where the command failed later.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(130)
    except RefusedError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except GdpError as error:
        sys.exit(f"error: {error}")


def run_bench(parser: argparse.ArgumentParser, measure: Callable[[Options], Outcome]) -> None:
    """Parse the command line, and run a bench to its table, JSON record and picture."""
    perform(parse(parser), measure)


def perform(options: Options, measure: Callable[[Options], Outcome]) -> None:
    """Run a bench to its table, JSON record and picture."""
    is_saved = not getattr(options, "no_save", False)
    is_drawn = is_saved and _is_whole(options) and not getattr(options, "no_plot", True)
    if is_drawn:
        require_plot()
    state, begun_s = machine_state(), time.monotonic()
    with clean_exit():
        if is_saved and hasattr(options, "allow_load"):
            _require_page(options, state)
        RunRegistry().sweep()  # remains of a killed run
        calibrated = calibration()
        outcome = measure(options)
    outcome = replace(outcome, settings={**outcome.settings, **calibrated})
    finish(outcome, options, state, time.monotonic() - begun_s, is_saved=is_saved, is_drawn=is_drawn)


def _require_page(options: Options, state: MachineState) -> None:
    """Refuse to measure for files that could not be written, or not be trusted. Raises ``RefusedError``: such files."""
    is_quick = getattr(options, "quick", False)
    chosen: Path | None = getattr(options, "json", None)
    if chosen or not is_quick:
        require_writable(chosen.parent if chosen else OUTPUT)
    if not is_quick and (chosen or _is_whole(options)):
        require_trust(state, allow_load=options.allow_load)


def _is_whole(options: Options) -> bool:
    """Return whether a bench measures all that its files below ``docs/benchmarks`` have; a part needs ``--json``."""
    is_whole: Callable[[Options], bool] | None = getattr(options, "is_whole", None)
    return not getattr(options, "quick", False) and (is_whole is None or is_whole(options))


def finish(
    outcome: Outcome, options: Options, state: MachineState, took_s: float, *, is_saved: bool, is_drawn: bool
) -> None:
    """Print an outcome, and write the files that the options select."""
    rounds = {"rounds": options.rounds} if hasattr(options, "rounds") else {}
    settings: Settings = {**rounds, **outcome.settings, "burst core": VARIANT, "took, s": round(took_s)}
    show(outcome.title, state, settings, outcome.rounds, outcome.targets)
    own = OUTPUT if _is_whole(options) else None
    record = getattr(options, "json", None) or (own and own / f"{outcome.name}.json")
    if is_saved and record:
        write_json(record, outcome.name, state, settings, outcome.rounds, outcome.targets, keeps=outcome.keeps_rows)
    if is_drawn and own:
        save_bars(own / f"{outcome.name}.png", outcome.title, str(state), outcome.panels)
    if outcome.has_failed:
        sys.exit(1)
