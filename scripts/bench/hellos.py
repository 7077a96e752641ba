"""Cost of immediate loss detection: processor time of a switch with twenty neighbours and no traffic.

One switch, joined to twenty others by a link each; every switch is a process in a namespace of its own. After all are
up, the processor time of the one in the middle is taken over each round, with keepalives as shipped, and without.

    sudo .venv/bin/python scripts/bench/hellos.py
    sudo .venv/bin/python scripts/bench/hellos.py --neighbours 5 --seconds 5 --rounds 1 --no-save
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import asdict
from pathlib import Path
from typing import Final

from faults.overlay import Overlay
from faults.plan import Plan, make_topology
from machine import machine_state, processor_s
from report import progress
from rich.console import Console
from rich.table import Table
from skeleton import clean_exit, command_line, new_run

from gdp.host.run_registry import RunRegistry

OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks" / "hellos.json"
TARGET: Final = 1.0  # percent of a core
SETTLE_S: Final = 8.0  # hellos are frequent until keepalives have taken over
_CASES: Final[dict[str, int | None]] = {"keepalives as shipped": None, "no keepalives": 0}


def plan(neighbours: int) -> Plan:
    """Return a star without traffic."""
    leaves = [f"s{number}" for number in range(1, neighbours + 1)]
    topology, members = make_topology({"home": ("s0", *leaves)}, {}, [f"s0-{leaf}" for leaf in leaves], ("s0",), {})
    return Plan(topology, members)


def measure(runs: RunRegistry, neighbours: int, seconds: float, rounds: int, keepalive_ms: int | None) -> list[float]:
    """Return the percent of a core that the switch in the middle took, one figure a round."""
    more = {} if keepalive_ms is None else {"switch": {"keepalive_ms": keepalive_ms}}
    with new_run(runs) as run, Overlay(run, plan(neighbours), more=more) as overlay:
        overlay.start_all()
        time.sleep(SETTLE_S)
        pid, figures = overlay.pid("switch s0"), []
        for _ in range(rounds):
            before, begun_s = processor_s(pid), time.monotonic()
            time.sleep(seconds)
            figures.append(100 * (processor_s(pid) - before) / (time.monotonic() - begun_s))
    return figures


def main() -> None:
    """Measure both cases."""
    parser = command_line(__doc__, rounds=5, seconds=20.0, seconds_of="of each round")
    parser.add_argument("--neighbours", type=int, default=20)
    parser.add_argument("--no-save", action="store_true", help=f"do not write {OUTPUT.name}")
    options = parser.parse_args()
    state, runs = machine_state(), RunRegistry()
    runs.sweep()
    found: dict[str, list[float]] = {}
    with clean_exit():
        for case, keepalive_ms in _CASES.items():
            progress(f"{options.neighbours} neighbours, {case}")
            found[case] = measure(runs, options.neighbours, options.seconds, options.rounds, keepalive_ms)
    table = Table(f"{options.neighbours} neighbours", "% of a core, median", "lowest-highest", "to reach")
    for case, figures in found.items():
        target = f"≤ {TARGET:g}" if case != "no keepalives" else ""
        table.add_row(case, f"{statistics.median(figures):.2f}", f"{min(figures):.2f}-{max(figures):.2f}", target)
    Console().print(table)
    if not options.no_save:
        OUTPUT.write_text(json.dumps({"machine": asdict(state), "neighbours": options.neighbours, **found}, indent=1))


if __name__ == "__main__":
    main()
