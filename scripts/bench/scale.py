"""Scale bench: cost of a large forwarding table, and load of a RIB.

    sudo .venv/bin/python scripts/bench/scale.py                      minutes; JSON and plot to docs/benchmarks
    sudo .venv/bin/python scripts/bench/scale.py --quick --no-save    a small table, to see that all works

Tables of 1,000, 100,000 and 1,000,000 names, in the raw and the kernel plane. Each has a chain of its own with
one switch, all at the same time, so that frames are sent on all of them in turn:

installs/s     new entries put into the table and, where there is one, the kernel's map: 100,000 a call
renewals/s     the same entries again, under a new lease
table B/entry  growth of the process; "map": memory of the kernel's maps in addition (memlock)
frames/s       of 128 bytes, spread over 1,024 names of the table (--spread), under 0.1 % loss, through one switch
CPU µs/frame   then: of source, soft interrupts and switch; the sink is left out

Half of the entries are for a destination, half for destination and source. The RIB is one process without a network
(``rib_load.py``): advertisements taken and queries answered in a second of one core, and memory a name.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from baselines import Plane
from chains import Chain
from peers.process import FailedError, Started, figures_of
from plot import Panel, panel_of
from rate_search import LOSS_MAX, Try, highest
from report import Rounds, Target, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.errors import LocalError
from gdp.host.run_registry import RunRegistry

PLANES: Final = ("kernel", "raw")
SIZES: Final = (1_000, 100_000, 1_000_000)
RIB: Final = "RIB"
SPREAD: Final = 1_024
FRAME_BYTES: Final = 128
GUESS: Final = 150_000.0  # first rate for raw, in frames/s
REPEATS: Final = 3  # tries without a search; their median is the round's figure
INSTALLS, RENEWALS, RATE, CPU = "installs/s", "renewals/s", "frames/s", "CPU µs/frame"
TABLE, MAP = "table B/entry", "map B/entry"
ADVERTISED, ASKED, KEPT = "advertisements verified/s", "queries/s", "B/name"


def measure_plane(kind: str, chains: dict[int, Chain], over: Rounds, seconds: float, spread: int) -> None:
    """Fill a table of every size, then send through all of them in turn."""
    with ExitStack() as undo:
        planes: dict[int, Plane] = {}
        for names, chain in chains.items():
            plane = Plane(kind, processes=kind == "raw", names=names)
            try:
                undo.enter_context(plane.stand(chain))
            except (LocalError, FailedError) as error:
                over.absent(kind, str(error))
                return
            planes[names] = plane
            progress(f"  {names:,} names")
            _fill(plane.workers()[0], names, kind, over)
        held: dict[int, list[Try]] = {names: [] for names in chains}
        for _ in range(1 if planes[min(planes)].processes else REPEATS):
            for names, plane in planes.items():
                wire = plane.wire(chains[names], FRAME_BYTES)
                attempt = partial(chains[names].attempt, wire, plane.workers(), seconds=seconds, spread=(spread, names))
                best = highest(attempt, GUESS if plane.processes else None)
                held[names] += [best] if best else []
        for names, tries in held.items():
            rates, costs = [each.rate for each in tries], [each.cpu_s / each.got * 1e6 for each in tries]
            over.add(kind, case_of(names), RATE, statistics.median(rates) if rates else None)
            over.add(kind, case_of(names), CPU, statistics.median(costs) if costs else None)


def _fill(worker: Started, names: int, kind: str, over: Rounds) -> None:
    filled, case = figures_of(worker.ask(do="fill")), case_of(names)
    if filled["placed"] != names:
        raise FailedError(f"{kind}: the table took {filled['placed']:.0f} of {names} entries")
    over.add(kind, case, INSTALLS, filled["installs_per_s"])
    over.add(kind, case, RENEWALS, filled["renewals_per_s"])
    over.add(kind, case, TABLE, filled["resident_bytes"] / names)
    over.add(kind, case, MAP, filled["map_bytes"] / names)


def measure_rib(names: int, over: Rounds) -> None:
    """Run one RIB in a process of its own."""
    script = str(Path(__file__).with_name("rib_load.py"))
    done = subprocess.run([sys.executable, script, str(names)], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise LocalError("the RIB of the bench ended early; see above")
    load = json.loads(done.stdout)
    over.add(RIB, f"RIB, {names:,} names", ADVERTISED, load["advertisements_per_s"])
    over.add(RIB, f"RIB, {names:,} names", ASKED, load["queries_per_s"])
    over.add(RIB, f"RIB, {names:,} names", KEPT, load["bytes_a_name"])


def case_of(names: int) -> str:
    """Return the heading of a table."""
    return f"{names:,} names"


def targets_of(over: Rounds, sizes: Sequence[int], rib_names: int) -> list[Target]:
    """Return the targets."""
    small, large = case_of(min(sizes)), case_of(max(sizes))
    return [
        *(
            over.ratio(f"{plane}: {large} / {small}, frames/s", plane, plane, large, RATE, 0.95, other_case=small)
            for plane in PLANES
        ),
        *(
            over.ratio(f"{plane}: {large} / {small}, {CPU}", plane, plane, large, CPU, None, other_case=small)
            for plane in PLANES
        ),
        *(over.target(f"{plane}, {large}: {INSTALLS} in bulk", plane, large, INSTALLS, 300_000) for plane in PLANES),
        over.target(f"RIB: {ADVERTISED}, one core", RIB, f"RIB, {rib_names:,} names", ADVERTISED, 2_000),
    ]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure both planes and the RIB, round by round."""
    sizes, rib_names = ((1_000, 10_000), 300) if options.quick else (SIZES, 3_000)
    over = Rounds()
    with ExitStack() as undo:
        chains = {names: undo.enter_context(Chain(runs, 1, 1_500)) for names in sizes}
        for number in range(1, options.rounds + 1):
            for kind in PLANES:
                if kind not in over.reasons and (not options.only or kind in options.only):
                    progress(f"round {number} of {options.rounds}: {kind}")
                    measure_plane(kind, chains, over, options.seconds, options.spread)
            if not options.only or RIB in options.only:
                progress(f"round {number} of {options.rounds}: RIB")
                measure_rib(rib_names, over)
    settings = {
        "rounds": options.rounds,
        "seconds a try": options.seconds,
        "loss below": LOSS_MAX,
        "MTU": 1_500,
        "frames": f"{FRAME_BYTES} B, one switch, {options.spread:,} names of the table",
        "cores": "source 0, sink 1, switch anywhere",
    }
    targets = targets_of(over, sizes, rib_names)
    return Outcome("scale", "Scale", over, targets, settings, lambda: panels_of(over, sizes))


def panels_of(over: Rounds, sizes: Sequence[int]) -> list[Panel]:
    """Return a panel for each figure of a table: planes by sizes."""
    return [
        panel_of_cases(over, column, [case_of(names) for names in sizes]) for column in (RATE, INSTALLS, TABLE, MAP)
    ]


def panel_of_cases(over: Rounds, column: str, cases: Sequence[str]) -> Panel:
    """Return one panel with a bar for each plane and size."""
    panels = [panel_of(over, case, column, [plane], ours=PLANES) for plane in PLANES for case in cases]
    labels = [f"{plane}, {case}" for plane in PLANES for case in cases]
    bars = [
        replace(bar, label=label)
        for panel, label in zip(panels, labels, strict=True)
        for bar in panel.bars
        if bar.median
    ]
    return Panel(column, panels[0].unit, bars)


if __name__ == "__main__":
    parser = command_line(
        __doc__,
        rounds=3,
        seconds=0.3,
        seconds_of="length of one try",
        quick={"rounds": 1, "seconds": 0.15},
        has_record=True,
        has_plot=True,
    )
    parser.add_argument("--spread", type=int, default=SPREAD, help="names that frames go to; a power of two")
    parser.add_argument("--only", action="append", choices=[*PLANES, RIB], default=[], help="may be repeated")
    run_bench(parser, measure)
