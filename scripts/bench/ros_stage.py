"""Common parts of the benches with real ROS nodes: the command line, the turns of a round, and the output.

I/O. Makes a row for each selected MTU, and removes them. A bench is data: what the proxies carry,
the turns of a round, and their figures. A turn that fails has no figures in that round, and the results list the
reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import skeleton
from plot import Panel, panel_of
from report import Rounds, Target
from ros_row import Carried, Row
from skeleton import Options
from testbed import BUFFER_BYTES

from gdp.host.run_registry import RunRegistry
from lab.process import FailedError, figures_of
from proxy.config.config import Encoding

DIRECT: Final = "direct"
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
CORES: Final = "both proxies, cores"
_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")

Measured = tuple[Mapping[str, object], float]  # last report of a node, and the cores that both proxies used


@dataclass(frozen=True, slots=True)
class Turn:
    """One measurement of every round.

    Args:
        encoding: how proxies carry messages; None: they go directly.
        counts: further columns, each with its key in the report.
        variant: how the proxies' rule differs, for the name of the row.
        report: measures; gets the row, the encoding and the number of the round, from 1; may raise ``FailedError``.
    """

    case: str
    mtu: int
    encoding: Encoding | None
    counts: Mapping[str, str]
    report: Callable[[Row, Encoding | None, int], Measured]
    variant: str = ""

    @property
    def contender(self) -> str:
        """Return the row of its figures."""
        return DIRECT if self.encoding is None else f"overlay, {self.encoding}{self.variant}"

    @property
    def columns(self) -> list[str]:
        """Return the columns that it fills."""
        return [MEDIAN, P99, *self.counts, *([] if self.encoding is None else [CORES])]

    def measure(self, row: Row, number: int) -> dict[str, float]:
        """Return the figures of one trial, by column.

        Raises ``FailedError``: a node did not come up, or nothing was received.
        """
        said, cores = self.report(row, self.encoding, number)
        figures = figures_of(said)
        if "p50_s" not in figures:
            raise FailedError("nothing was received")
        found = {MEDIAN: 1e3 * figures["p50_s"], P99: 1e3 * figures["p99_s"]}
        found |= {column: figures[key] for column, key in self.counts.items()}
        return found if self.encoding is None else {**found, CORES: cores}


@dataclass(frozen=True, slots=True)
class Bench:
    """A bench, as data. ``targets_of`` returns the targets at one MTU."""

    name: str
    title: str
    carried: Sequence[Carried]
    turns: Sequence[Turn]
    targets_of: Callable[[Rounds, int], list[Target]]
    settings: Mapping[str, str | int | float] = field(default_factory=dict)

    def targets(self, over: Rounds) -> list[Target]:
        """Return the targets at every MTU."""
        mtus = dict.fromkeys(turn.mtu for turn in self.turns)
        return [target for mtu in mtus for target in self.targets_of(over, mtu)]

    def panels(self, over: Rounds) -> Iterator[Panel]:
        """Yield a panel for each case: medians, whiskers to the p99."""
        for case in dict.fromkeys(turn.case for turn in self.turns):
            ours = [turn.contender for turn in self.turns if turn.case == case and turn.encoding]
            yield panel_of(over, case, MEDIAN, [*ours, DIRECT], p99=P99, ours=ours)


def parse(description: str | None, *, seconds: float, mtus: Sequence[int], quick_s: float, rounds: int = 3) -> Options:
    """Read the command line; ``seconds`` and ``rounds`` are final, and ``mtus`` the selected ones."""
    quick = {"rounds": 1, "seconds": quick_s}
    parser = skeleton.command_line(
        description, rounds=rounds, seconds=seconds, quick=quick, has_record=True, has_plot=True
    )
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    options = skeleton.parse(parser)
    options.mtus = tuple(dict.fromkeys(options.mtu or mtus))
    return options


def main(
    bench_of: Callable[[Options], Bench],
    description: str | None,
    *,
    seconds: float,
    mtus: Sequence[int],
    quick_s: float,
) -> None:
    """Run the bench that the command line selects to its table, file and picture."""
    options = parse(description, seconds=seconds, mtus=mtus, quick_s=quick_s)
    skeleton.perform(options, partial(_measure, bench_of(options)))


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
    return skeleton.Outcome(
        bench.name, bench.title, over, bench.targets(over), settings, lambda: list(bench.panels(over))
    )
