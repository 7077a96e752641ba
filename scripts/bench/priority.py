"""How late a small urgent message is while images fill the path: a tick of 100 bytes at 100 Hz over three switches.

One member at A ticks; what floods the same path is, in turn:

    idle                        nothing
    own images                  the same member's images of 921,600 bytes, reliable, as fast as they are confirmed
    own images, best effort     the same, as fast as they can be sent
    another's images            those of another member at the same switch, reliable

over three switches with the data plane ``kernel``, then ``raw``; on links as fast as the machine, where both its cores
are busy, and with 100 Mbit/s between the first two switches, where a queue is what is full. Latency is one way, from
when a tick was due to when B's program has it. Asked: p99 of no flood above twice the idle p99 and one frame's time.

    sudo .venv/bin/python scripts/bench/priority.py                     # the whole; writes docs/benchmarks/priority.*
    sudo .venv/bin/python scripts/bench/priority.py --quick --no-save   # a few seconds: does it work?
    sudo .venv/bin/python scripts/bench/priority.py --only raw --link shaped --seconds 20 --no-save
    sudo .venv/bin/python scripts/bench/priority.py --realtime          # all processes under SCHED_FIFO
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from machine import machine_state
from peers.process import FailedError
from plot import Panel, panel_of, require_plot, save_bars
from priority_endpoint import TICK_S
from priority_row import MTU, SHAPED_BITS_S, Row
from report import Goal, Rounds, Settings, percentile, progress, show, write_json

from gdp.errors import LocalError
from gdp.nodes.spin import SPIN_US
from gdp.testbed.runs import Run, Runs

PLANES: Final = ("kernel", "raw")
LINKS: Final = {"free": "free links", "shaped": f"{SHAPED_BITS_S // 1_000_000} Mbit/s"}
IDLE: Final = "idle"
FLOODS: Final = {  # whose images, and how
    IDLE: ("nobody", ""),
    "own images": ("a", "reliable"),
    "own images, best effort": ("a", "best-effort"),
    "another's images": ("c", "reliable"),
}
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
WORST: Final = "worst, ms"
IMAGES: Final = "images/s"
OF_BOUND: Final = "p99 / (2 x idle p99 + frame)"
OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"
QUICK_S: Final = 1.0
READY_S: Final = 20.0
FRAME_MS: Final = {"free": 0.0, "shaped": (MTU + 14) * 8e3 / SHAPED_BITS_S}


def case_of(plane: str, link: str) -> str:
    """Return the name of a case."""
    return f"{plane}, {LINKS[link]}"


def measure(row: Row, flood: str, seconds: float, spin_s: float) -> dict[str, float]:
    """Return the figures of one flood, by column.

    Raises:
        FailedError: a process did not come up, or a tick did not arrive.
    """
    where, kind = FLOODS[flood]
    with ExitStack() as stack:
        reader = stack.enter_context(row.end("b", "read", spin_s=spin_s))
        reader.read(READY_S)
        if where == "c":
            stack.enter_context(row.end("c", "flood", flood=kind, spin_s=spin_s)).read(READY_S)
        own = kind if where == "a" else ""
        ticker = stack.enter_context(row.end("a", "tick", flood=own, seconds=seconds, spin_s=spin_s))
        ticker.read(2 * READY_S + seconds)
        said = reader.read(READY_S)
    latencies_s, images_s = said.get("latencies_s"), said.get("images_s")
    if not isinstance(latencies_s, list) or not isinstance(images_s, float):
        raise FailedError(f"B said {said}")
    latencies_ms = [1e3 * each for each in latencies_s]
    if len(latencies_ms) < round(seconds / TICK_S):
        raise FailedError(f"of {round(seconds / TICK_S)} ticks {len(latencies_ms)} arrived")
    return {
        MEDIAN: percentile(latencies_ms, 0.5),
        P99: percentile(latencies_ms, 0.99),
        WORST: max(latencies_ms),
        IMAGES: images_s,
    }


class Turns:
    """The rounds under way: in each, every plane on every link, and there every flood.

    Attributes:
        over: the figures.
        notes: what went wrong.
    """

    def __init__(
        self,
        runs: Runs,
        planes: Sequence[str],
        links: Sequence[str],
        seconds: float,
        spin_s: float,
        *,
        realtime: bool,
    ) -> None:
        self._runs = runs
        self._is_realtime = realtime
        self._cases = [(plane, link) for plane in planes for link in links]
        self._seconds = seconds
        self._spin_s = spin_s
        self.over = Rounds()
        self.notes: list[str] = []

    def run(self, rounds: int) -> None:
        """Run all rounds.

        Raises:
            LocalError: the kernel refuses.
        """
        for at in range(1, rounds + 1):
            for plane, link in self._cases:
                run = self._runs.start()
                try:
                    self._on_row(run, plane, link, f"round {at}/{rounds}")
                finally:
                    run.end()

    def _on_row(self, run: Run, plane: str, link: str, where: str) -> None:
        case = case_of(plane, link)
        bound_ms: float | None = None
        with Row(run, plane, shaped=link == "shaped", realtime=self._is_realtime) as row:
            for flood in FLOODS:
                progress(f"{where}, {case}: {flood}")
                try:
                    found: dict[str, float] = measure(row, flood, self._seconds, self._spin_s)
                except FailedError as error:
                    progress(f"FAILED: {error}")
                    self.notes.append(f"{where}, {case}, {flood}: {error}")
                    found = {}
                if flood == IDLE and found:
                    bound_ms = 2 * found[P99] + FRAME_MS[link]
                for column in (MEDIAN, P99, WORST, IMAGES):
                    self.over.add(flood, case, column, found.get(column))
                is_known = bound_ms is not None and P99 in found
                self.over.add(flood, case, OF_BOUND, found[P99] / bound_ms if is_known and bound_ms else None)


def goals_of(over: Rounds, cases: Sequence[str]) -> list[Goal]:
    """Return what was asked for: no flood passes the bound, which idle itself makes in each round."""
    floods = [flood for flood in FLOODS if flood != IDLE]
    goals = [over.goal(f"{case}: {flood}, {OF_BOUND}", flood, case, OF_BOUND, 1.0, at_most=True)
             for case in cases for flood in floods]  # fmt: skip
    told = [over.ratio(f"{case}: {flood} / {IDLE}, p99", flood, IDLE, case, P99, None)
            for case in cases for flood in floods]  # fmt: skip
    return goals + told


def panels_of(over: Rounds, cases: Sequence[str]) -> list[Panel]:
    """Return a panel for each case: medians, whiskers to the p99."""
    return [panel_of(over, case, MEDIAN, list(FLOODS), p99=P99, ours=list(FLOODS)) for case in cases]


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0, help="of ticks for each figure (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help=f"one round of {QUICK_S:g} s each")
    parser.add_argument("--only", action="append", choices=PLANES, help="this data plane")
    parser.add_argument("--link", action="append", choices=list(LINKS), help="on such links")
    parser.add_argument("--spin-us", type=int, default=SPIN_US, help="as spin_us of proxy.yaml (default: %(default)s)")
    parser.add_argument("--realtime", action="store_true", help="SCHED_FIFO: what else runs does not disturb")
    parser.add_argument("--json", type=Path, default=OUTPUT / "priority.json", help="where the figures go")
    parser.add_argument("--plot", type=Path, default=OUTPUT / "priority.png", help="where the picture goes")
    parser.add_argument("--no-plot", action="store_true", help="no picture")
    parser.add_argument("--no-save", action="store_true", help="print only")
    return parser


def main() -> None:
    """Run the bench, or a part of it."""
    options = arguments().parse_args()
    is_drawn = not (options.no_plot or options.no_save)
    if is_drawn:
        require_plot()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was made is removed
    state, begun_s = machine_state(), time.monotonic()
    planes, links = options.only or PLANES, options.link or list(LINKS)
    rounds, seconds = (1, QUICK_S) if options.quick else (options.rounds, options.seconds)
    runs = Runs()
    runs.sweep()
    turns = Turns(runs, planes, links, seconds, options.spin_us / 1e6, realtime=options.realtime)
    try:
        turns.run(rounds)
    except KeyboardInterrupt:
        sys.exit(130)
    except (LocalError, FailedError) as error:
        sys.exit(f"error: {error}")
    settings: Settings = {
        "rounds": rounds,
        "ticks for each figure": round(seconds / TICK_S),
        "MTU": MTU,
        "one frame's time at 100 Mbit/s, ms": round(FRAME_MS["shaped"], 3),
        "scheduler": "SCHED_FIFO" if options.realtime else "ordinary",
        "ends spin, us": options.spin_us,
        "trouble": turns.notes or "none",
        "took, s": round(time.monotonic() - begun_s),
    }
    cases = [case_of(plane, link) for plane in planes for link in links]
    title = "A tick of 100 bytes at 100 Hz beside images, over three switches"
    goals = goals_of(turns.over, cases)
    show(title, state, settings, turns.over, goals)
    if not options.no_save:
        write_json(options.json, "priority", state, settings, turns.over, goals)
    if is_drawn:
        save_bars(options.plot, title, str(state), panels_of(turns.over, cases))


if __name__ == "__main__":
    main()
