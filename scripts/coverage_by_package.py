#!/usr/bin/env python3
"""Branch coverage of each package, from the data of the last measurement.

    scripts/coverage_by_package.py            table; needs the .coverage file that nox -s coverage writes
    scripts/coverage_by_package.py --json     the same for programs

Covered are statements and branches together, as in the report of coverage.py. Exit status: 0 the total meets the limit
in pyproject.toml, 1 it does not.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from coverage import Coverage

ROOT = Path(__file__).resolve().parent.parent
TOTAL = "total"


def percentages(files: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return the covered percentage of each top package, each of its packages, and the total, from a JSON report."""
    counts = defaultdict[str, list[int]](lambda: [0, 0])
    for path, file in files.items():
        summary = file["summary"]
        package = Path(path).parent.parts[:2]
        for name in {".".join(package), package[0], TOTAL}:
            counts[name][0] += summary["covered_lines"] + summary["covered_branches"]
            counts[name][1] += summary["num_statements"] + summary["num_branches"]
    return {name: 100.0 * covered / possible if possible else 100.0 for name, (covered, possible) in counts.items()}


def main(arguments: Sequence[str]) -> int:
    """Print the table; return the exit status."""
    if arguments not in ([], ["--json"]):
        print(__doc__)
        return 0 if "--help" in arguments else 2
    measured = Coverage(config_file=str(ROOT / "pyproject.toml"))
    measured.load()
    with TemporaryDirectory() as scratch:
        report = Path(scratch) / "report.json"
        measured.json_report(outfile=str(report))
        found = percentages(json.loads(report.read_text())["files"])
    limit = float(measured.get_option("report:fail_under") or 0.0)  # type: ignore[arg-type]
    if arguments:
        print(json.dumps({name: round(share, 1) for name, share in sorted(found.items())}))
    else:
        for name, share in sorted(found.items(), key=lambda item: (item[0] == TOTAL, item[0])):
            print(f"{name:30}{share:6.1f} %")
    return 0 if found[TOTAL] >= limit else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
