"""What the benches with real ROS nodes share: the command line, the rounds, and what is printed, written and drawn.

Place: shell; lays a row for each MTU that is asked for, and takes them down. A bench is data: what the proxies carry,
the turns of a round, and the figures that are wanted of them. A turn that fails has no figures in that round, and why
is told with the results.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from machine import machine_state
from peers.process import FailedError
from plot import Panel, require_plot, save_bars
from report import Rounds, Settings, Target, progress, show, write_json
from ros_row import BUFFER_BYTES, Carried, Row

from gdp.errors import LocalError
from gdp.testbed.runs import Runs

__all__ = ["DIRECT", "Bench", "Options", "Turn", "parse", "perform"]

DIRECT: Final = "direct"
_OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"
_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")

Options = argparse.Namespace


@dataclass(frozen=True, slots=True)
class Turn:
    """One thing to measure in every round. ``columns`` are what ``measure`` returns when it succeeds.

    ``measure`` is told the row and the number of the round, from 1, and may raise ``FailedError``.
    """

    case: str
    contender: str
    mtu: int
    columns: Sequence[str]
    measure: Callable[[Row, int], Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class Bench:
    """A bench, as data."""

    name: str
    title: str
    carried: Sequence[Carried]
    turns: Sequence[Turn]
    targets: Callable[[Rounds], list[Target]]
    panels: Callable[[Rounds], list[Panel]]
    settings: Mapping[str, str | int | float] = field(default_factory=dict)


def parse(description: str, name: str, *, rounds: int, seconds: float, mtus: Sequence[int], quick_s: float) -> Options:
    """Read the command line; ``seconds`` and ``rounds`` are final, and ``mtus`` those that are asked for."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=rounds)
    parser.add_argument("--seconds", type=float, default=seconds, help="of each figure (default: %(default)s)")
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    parser.add_argument("--quick", action="store_true", help=f"one round of {quick_s:g} s each")
    parser.add_argument("--json", type=Path, default=_OUTPUT / f"{name}.json", help="where the figures go")
    parser.add_argument("--plot", type=Path, default=_OUTPUT / f"{name}.png", help="where the picture goes")
    parser.add_argument("--no-plot", action="store_true", help="no picture")
    parser.add_argument("--no-save", action="store_true", help="print only")
    options = parser.parse_args()
    if options.quick:
        options.rounds, options.seconds = 1, quick_s
    options.mtus = tuple(dict.fromkeys(options.mtu or mtus))
    return options


def perform(bench: Bench, options: Options) -> None:
    """Run the bench to its table, file and picture."""
    is_drawn = not (options.no_plot or options.no_save)
    if is_drawn:
        require_plot()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was made is removed
    state, begun_s = machine_state(), time.monotonic()
    try:
        over, notes = _run_rounds(bench, options.rounds)
    except KeyboardInterrupt:
        sys.exit(130)
    except (LocalError, FailedError) as error:
        sys.exit(f"error: {error}")
    settings: Settings = {
        "rounds": options.rounds,
        "seconds": options.seconds,
        **bench.settings,
        "socket buffers, B": min(BUFFER_BYTES, int(_RMEM_MAX.read_text(encoding="ascii"))),
        "trouble": notes or "none",
        "took, s": round(time.monotonic() - begun_s),
    }
    targets = bench.targets(over)
    show(bench.title, state, settings, over, targets)
    if not options.no_save:
        write_json(options.json, bench.name, state, settings, over, targets)
    if is_drawn:
        save_bars(options.plot, bench.title, str(state), bench.panels(over))


def _run_rounds(bench: Bench, rounds: int) -> tuple[Rounds, list[str]]:
    over, notes, runs = Rounds(), list[str](), Runs()
    runs.sweep()
    with ExitStack() as stack:
        rows = {}
        for mtu in dict.fromkeys(turn.mtu for turn in bench.turns):
            run = runs.start()
            stack.callback(run.end)
            rows[mtu] = stack.enter_context(Row(run, bench.carried, mtu=mtu))
        for at in range(1, rounds + 1):
            for turn in bench.turns:
                where = f"round {at}/{rounds}, {turn.case}: {turn.contender}"
                progress(where)
                found: Mapping[str, float] = {}
                try:
                    found = turn.measure(rows[turn.mtu], at)
                except FailedError as error:
                    progress(f"FAILED: {error}")
                    notes.append(f"{where}: {error}")
                for column in turn.columns:
                    over.add(turn.contender, turn.case, column, found.get(column))
    return over, notes
