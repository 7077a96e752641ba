"""Bench: which pairs of internet accesses connect through real switches, and which of them without the border.

    sudo .venv/bin/python scripts/bench/nat_matrix.py                  all pairs, as a table
    sudo .venv/bin/python scripts/bench/nat_matrix.py --json           for programs
    sudo .venv/bin/python scripts/bench/nat_matrix.py --kinds public symmetric

Exit status: 0 every pair is as ``lab.internet.access`` says, 1 one is not.
"""

from __future__ import annotations

import argparse
import json
import sys

from report import print_table

from gdp.host.run_registry import RunRegistry
from lab.internet.access import Access
from lab.internet.laboratory import Laboratory
from lab.internet.matrix import Outcome, Pair, batches, measure
from lab.process import new_run

KINDS = [each.value for each in Access]


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Which pairs of internet accesses connect through real switches.")
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=KINDS, metavar="KIND", help="of: " + ", ".join(KINDS)
    )
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")
    options = parser.parse_args()
    kinds = [Access(each) for each in options.kinds]
    RunRegistry().sweep()  # remains of a killed run
    found: dict[Pair, Outcome] = {}
    for batch in batches(kinds):
        with new_run() as run, Laboratory(run) as laboratory:
            found = {**measure(laboratory, batch), **found}
    if options.json:
        pairs = [{"pair": [a.value, b.value], **outcome._asdict()} for (a, b), outcome in found.items()]
        print(json.dumps(pairs, indent=1))
    else:
        rows = [(one.value, *(_cell((one, other), found[one, other]) for other in kinds)) for one in kinds]
        print_table(("first call answered after", *(each.value for each in kinds)), rows)
        connected = [each for each in found.values() if each.reached_s is not None]
        direct = sum(each.direct_s is not None for each in connected)
        print(f"{len(connected)} of {len(found)} pairs connect, {direct} directly")
    return 0 if all(outcome.is_as_expected(pair) for pair, outcome in found.items()) else 1


def _cell(pair: Pair, outcome: Outcome) -> str:
    if outcome.reached_s is None:
        return "never"
    way = "border" if outcome.direct_s is None else "direct"
    return f"{way} {outcome.reached_s:.1f} s" + ("" if outcome.is_as_expected(pair) else " !")


if __name__ == "__main__":
    sys.exit(main())
