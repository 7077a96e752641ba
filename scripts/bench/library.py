"""Cost of the library: a message and a small answer over three switches, by ``import gdp`` and by the internal path.

Both paths run in turn, round by round, on the machines of ``messages.py``: keys, switches and RIB start again for each.
The internal path is a member on its plane in one thread, without the library's queues, stamps and lock.

    sudo .venv/bin/python scripts/bench/library.py                # 100 B; prints medians, their range, and the ratio
    sudo .venv/bin/python scripts/bench/library.py --rounds 3 --size 10000
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Final

from machine import machine_state
from messages import positive, size_of
from peers.exchange import ANSWER, Load
from peers.figures import MEDIAN, case_of
from peers.gdp_net import GdpNet
from peers.turns import Plan, Turns
from report import Settings, show, write_json

from gdp.errors import LocalError
from gdp.host.run_registry import Runs
from gdp.nodes.spin import SPIN_US

ENCODING: Final = "cdr"
RATIO_MAX: Final = 1.05


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=positive, default=15)
    parser.add_argument("--count", type=positive, default=500, help="a quarter of the messages of a round")
    parser.add_argument("--size", type=size_of, default=100, help="bytes of a message (default: %(default)s)")
    parser.add_argument("--mtu", type=int, default=1_500, help="bytes after the Ethernet header")
    parser.add_argument("--plane", choices=("kernel", "raw"), default="raw", help="of the switches")
    parser.add_argument("--spin-us", type=int, default=SPIN_US, help="as spin_us of proxy.yaml (default: %(default)s)")
    parser.add_argument("--json", type=Path, help="write all figures here")
    return parser


def main() -> None:
    """Run the bench."""
    options = arguments().parse_args()
    library, internal = (
        GdpNet(options.plane, (ENCODING,), options.spin_us / 1e6, path) for path in ("library", "internal")
    )
    load = Load((options.size,), options.count)
    plan = Plan((options.mtu,), (False,), (internal, library), load, options.rounds)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was made is removed
    state, begun_s = machine_state(), time.monotonic()
    runs, turns = Runs(), Turns(plan)
    runs.sweep()
    try:
        turns.run(runs)
    except KeyboardInterrupt:
        sys.exit(130)
    except LocalError as error:
        sys.exit(f"error: {error}")
    settings: Settings = {
        "rounds": plan.rounds,
        "messages a round": [load.repeats(options.size)],
        "answer, B": ANSWER.size,
        "notes": turns.notes or "none",
        "took, s": round(time.monotonic() - begun_s),
    }
    case = case_of(options.size, options.mtu, offloads=False)
    what = f"library / internal, {case}"
    goal = turns.over.ratio(what, library.labels[0], internal.labels[0], case, MEDIAN, RATIO_MAX, at_most=True)
    show("Cost of the library", state, settings, turns.over, [goal])
    if options.json:
        write_json(options.json, "library", state, settings, turns.over, [goal])


if __name__ == "__main__":
    main()
