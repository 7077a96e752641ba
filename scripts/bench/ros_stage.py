"""Common parts of the benches with real ROS nodes: the command line, the rounds, and the output.

I/O. Makes a row for each selected MTU, and removes them. A bench is data: what the proxies carry,
the turns of a round, and their figures. A turn that fails has no figures in that round, and the results list the
reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import skeleton
from plot import Panel
from report import Rounds, Target
from ros_row import BUFFER_BYTES, Carried, Row
from skeleton import Options

from gdp.host.run_registry import RunRegistry

__all__ = ["DIRECT", "Bench", "Options", "Turn", "parse", "perform"]

DIRECT: Final = "direct"
_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")


@dataclass(frozen=True, slots=True)
class Turn:
    """One measurement of every round. ``columns`` are the keys that ``measure`` returns when it succeeds.

    ``measure`` gets the row and the number of the round, from 1, and may raise ``FailedError``.
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


def parse(description: str, *, rounds: int, seconds: float, mtus: Sequence[int], quick_s: float) -> Options:
    """Read the command line; ``seconds`` and ``rounds`` are final, and ``mtus`` the selected ones."""
    quick = {"rounds": 1, "seconds": quick_s}
    parser = skeleton.command_line(
        description, rounds=rounds, seconds=seconds, quick=quick, has_record=True, has_plot=True
    )
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    options = skeleton.parse(parser)
    options.mtus = tuple(dict.fromkeys(options.mtu or mtus))
    return options


def perform(bench: Bench, options: Options) -> None:
    """Run the bench to its table, file and picture."""
    skeleton.perform(options, partial(_measure, bench))


def _measure(bench: Bench, options: Options, runs: RunRegistry) -> skeleton.Outcome:
    recorder = skeleton.Recorder()
    with ExitStack() as stack:
        rows = {}
        for mtu in dict.fromkeys(turn.mtu for turn in bench.turns):
            run = stack.enter_context(skeleton.new_run(runs))
            rows[mtu] = stack.enter_context(Row(run, bench.carried, mtu=mtu))
        trials = [
            skeleton.Trial(each.case, each.contender, each.columns, partial(each.measure, rows[each.mtu]))
            for each in bench.turns
        ]
        recorder.interleave(trials, options.rounds)
    over = recorder.rounds
    settings = {
        "rounds": options.rounds,
        "seconds": options.seconds,
        **bench.settings,
        "socket buffers, B": min(BUFFER_BYTES, int(_RMEM_MAX.read_text(encoding="ascii"))),
        "trouble": recorder.notes or "none",
    }
    return skeleton.Outcome(bench.name, bench.title, over, bench.targets(over), settings, lambda: bench.panels(over))
