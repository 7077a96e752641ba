"""Cost of the library: a message and a small answer over three switches, by ``import gdp`` and by the internal path.

Both paths run in turn, round by round, on the machines of ``messages.py``: keys, switches and RIB start again for each.
The internal path is a member on its plane in one thread, without the library's queues, stamps and lock.

    sudo .venv/bin/python scripts/bench/library.py                # 100 B; prints medians, their range, and the ratio
    sudo .venv/bin/python scripts/bench/library.py --rounds 3 --size 10000
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from messages import positive, size_of
from peers.exchange import ANSWER, Load
from peers.figures import MEDIAN, case_of
from peers.gdp_net import GdpNet
from peers.rounds import Plan, Turns
from skeleton import Options, Outcome, command_line, run_bench

from gdp.host.run_registry import RunRegistry
from gdp.nodes.busy_poll import SPIN_US

ENCODING: Final = "cdr"
RATIO_MAX: Final = 1.05


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command_line(__doc__)
    parser.add_argument("--rounds", type=positive, default=15)
    parser.add_argument("--count", type=positive, default=500, help="a quarter of the messages of a round")
    parser.add_argument("--size", type=size_of, default=100, help="bytes of a message (default: %(default)s)")
    parser.add_argument("--mtu", type=int, default=1_500, help="bytes after the Ethernet header")
    parser.add_argument("--plane", choices=("kernel", "raw"), default="raw", help="of the switches")
    parser.add_argument(
        "--busy-poll-us", type=int, default=SPIN_US, help="as busy_poll_us of proxy.yaml (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, help="write all figures here")
    return parser


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure both paths in turn, round by round."""
    library, internal = (
        GdpNet(options.plane, (ENCODING,), options.busy_poll_us / 1e6, path) for path in ("library", "internal")
    )
    load = Load((options.size,), options.count)
    plan = Plan((options.mtu,), (False,), (internal, library), load, options.rounds)
    turns = Turns(plan)
    turns.run(runs)
    case = case_of(options.size, options.mtu, offloads=False)
    what = f"library / internal, {case}"
    target = turns.over.ratio(what, library.labels[0], internal.labels[0], case, MEDIAN, RATIO_MAX, at_most=True)
    return Outcome(
        "library",
        "Cost of the library",
        turns.over,
        [target],
        {
            "rounds": plan.rounds,
            "messages a round": [load.repeats(options.size)],
            "answer, B": ANSWER.size,
            "notes": turns.notes or "none",
        },
        is_whole=False,
    )


if __name__ == "__main__":
    run_bench(arguments(), measure)
