"""Bench: which pairs of internet accesses connect through real switches, and which of them without the border.

    sudo .venv/bin/python scripts/bench/nat_matrix.py                  all pairs, as a table
    sudo .venv/bin/python scripts/bench/nat_matrix.py --json           for programs
    sudo .venv/bin/python scripts/bench/nat_matrix.py --kinds public symmetric

Exit status: 0 every pair is as ``internet.access`` says, 1 one is not.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from rich.console import Console
from rich.table import Table

from gdp.host.run_registry import RunRegistry
from internet.access import Access
from internet.laboratory import Laboratory
from internet.matrix import Outcome, Pair, batches, measure

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
    found: dict[Pair, Outcome] = {}
    for batch in batches(kinds):
        found = {**_measured(batch), **found}
    if options.json:
        rows = [{"pair": [a.value, b.value], **outcome._asdict()} for (a, b), outcome in found.items()]
        print(json.dumps(rows, indent=1))
    else:
        _show(found, kinds)
    return 0 if all(outcome.is_as_expected(pair) for pair, outcome in found.items()) else 1


def _measured(kinds: Sequence[Access]) -> dict[Pair, Outcome]:
    run = RunRegistry().start()
    try:
        with Laboratory(run) as laboratory:
            return measure(laboratory, kinds)
    finally:
        run.end()


def _show(found: Mapping[Pair, Outcome], kinds: Sequence[Access]) -> None:
    table = Table("first call answered after", *(each.value for each in kinds))
    for one in kinds:
        table.add_row(one.value, *(_cell((one, other), found[one, other]) for other in kinds))
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table)
    connected = [each for each in found.values() if each.reached_s is not None]
    direct = [each for each in connected if each.direct_s is not None]
    console.print(f"{len(connected)} of {len(found)} pairs connect, {len(direct)} directly")


def _cell(pair: Pair, outcome: Outcome) -> str:
    if outcome.reached_s is None:
        return "never"
    way = "border" if outcome.direct_s is None else "direct"
    return f"{way} {outcome.reached_s:.1f} s" + ("" if outcome.is_as_expected(pair) else " !")


if __name__ == "__main__":
    sys.exit(main())
