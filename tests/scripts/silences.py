"""Silences of connected flows in drawn networks under drawn faults, in virtual time.

    PYTHONPATH=scripts:scripts/bench python -m tests.scripts.silences --count 200 --first 1000

Each seed draws a network of 8 to 13 switches and 15 s of overlapping faults. Signatures are ideal. A silence lasts from
one delivery to the next, while links and policy connect publisher and reader throughout.
"""

from __future__ import annotations

import argparse
import os
import sys
from multiprocessing import Pool
from random import Random
from typing import Final

from faults.plan import random_network
from faults.schedule import make_schedule

from tests.insiders.oracle import signing_oracle
from tests.scripts.simulated_chaos import SIMULATED, SimulatedChaos

FAULTS_S: Final = 15.0
LEAST_S: Final = 0.5  # the slowest flow has a message each 0.4 s
BOUNDS_S: Final = (0.5, 0.75, 1.0, 2.0, 5.0)


def silences(seed: int) -> tuple[list[float], list[str]]:
    """Return the silences above ``LEAST_S`` of a seed, in seconds, and which messages were lost without a report."""
    plan = random_network(seed, Random(seed).randint(8, 13), rate=0.25)
    with signing_oracle():
        chaos = SimulatedChaos(plan, make_schedule(plan, seed, FAULTS_S, kinds=SIMULATED), seed, keepalive_ms=None)
        chaos.settle()
        chaos.run()
    return chaos.silences(LEAST_S), chaos.broken_promises(60.0, 60.0)


def main() -> int:
    """Print each seed with a silence above a second, and how many silences exceed each bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="networks (200)")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first (1000)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (one for each core)")
    options = parser.parse_args()
    found: list[float] = []
    unreported = 0
    with Pool(options.jobs, maxtasksperchild=8) as pool:
        seeds = range(options.first, options.first + options.count)
        for seed, (seconds, broken) in zip(seeds, pool.imap(silences, seeds), strict=True):
            found += seconds
            unreported += len(broken)
            longest = max(seconds, default=0.0)
            if broken or longest > 1.0:
                print(f"seed {seed}: longest {longest:.2f} s; {'; '.join(broken) or 'all losses reported'}", flush=True)
    above = ", ".join(f"{sum(each > bound for each in found)} above {bound:g} s" for bound in BOUNDS_S)
    print(f"{options.count} networks: {above}; longest {max(found, default=0.0):.2f} s; {unreported} losses unreported")
    return 0


if __name__ == "__main__":
    sys.exit(main())
