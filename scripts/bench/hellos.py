"""Cost of immediate loss detection: processor time of a switch with twenty neighbours and no traffic.

One switch, joined to twenty others by a link each; every switch is a process in a namespace of its own. After all are
up, the processor time of the one in the middle is taken over each round, with keepalives as shipped, and without.

    sudo .venv/bin/python scripts/bench/hellos.py
    sudo .venv/bin/python scripts/bench/hellos.py --neighbours 5 --seconds 5 --rounds 1 --no-save
"""

from __future__ import annotations

import time
from typing import Final

from faults.overlay import Overlay
from faults.plan import Plan
from machine import processor_s
from report import Rounds, progress
from skeleton import Options, Outcome, command_line, new_run, run_bench
from topologies import make_topology

from gdp.host.run_registry import RunRegistry

TARGET: Final = 1.0
COLUMN: Final = "% of a core"
SHIPPED: Final = "keepalives as shipped"
SETTLE_S: Final = 8.0  # hellos are frequent until keepalives have taken over
_CASES: Final[dict[str, int | None]] = {SHIPPED: None, "no keepalives": 0}


def plan(neighbours: int) -> Plan:
    """Return a star without traffic."""
    leaves = [f"s{number}" for number in range(1, neighbours + 1)]
    topology, members = make_topology({"home": ("s0", *leaves)}, {}, [f"s0-{leaf}" for leaf in leaves], ("s0",), {})
    return Plan(topology, members)


def shares(runs: RunRegistry, options: Options, keepalive_ms: int | None) -> list[float]:
    """Return the percent of a core that the switch in the middle took, one figure a round."""
    more = {} if keepalive_ms is None else {"switch": {"keepalive_ms": keepalive_ms}}
    with new_run(runs) as run, Overlay(run, plan(options.neighbours), more=more) as overlay:
        overlay.start_all()
        time.sleep(SETTLE_S)
        pid, figures = overlay.pid("switch s0"), []
        for _ in range(options.rounds):
            before, begun_s = processor_s(pid), time.monotonic()
            time.sleep(options.seconds)
            figures.append(100 * (processor_s(pid) - before) / (time.monotonic() - begun_s))
    return figures


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure both cases."""
    over, heading = Rounds(), f"{options.neighbours} neighbours"
    for case, keepalive_ms in _CASES.items():
        progress(f"{heading}, {case}")
        for value in shares(runs, options, keepalive_ms):
            over.add(case, heading, COLUMN, value)
    target = over.target(f"{SHIPPED}, {COLUMN}", SHIPPED, heading, COLUMN, TARGET, at_most=True)
    settings = {"rounds": options.rounds, "seconds of a round": options.seconds}
    return Outcome("hellos", "Cost of immediate loss detection", over, [target], settings)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, seconds=20.0, seconds_of="of each round", has_record=True)
    parser.add_argument("--neighbours", type=int, default=20)
    run_bench(parser, measure)
