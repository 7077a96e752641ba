#!/usr/bin/env python3
"""Table of branch coverage by package, from the .coverage file that nox -s coverage writes.

Statements and branches count alike, as in the report of coverage.py.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from coverage import Coverage


def percentages(files: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return the covered percentage of each package of the first two levels, and the total, from a JSON report."""
    covered, possible = Counter[str](), Counter[str]()
    for path, file in files.items():
        summary = file["summary"]
        package = Path(path).parent.parts[:2]
        for name in {".".join(package), package[0], "total"}:
            covered[name] += summary["covered_lines"] + summary["covered_branches"]
            possible[name] += summary["num_statements"] + summary["num_branches"]
    return {name: 100.0 * covered[name] / count for name, count in possible.items() if count}


if __name__ == "__main__":
    measured = Coverage()
    measured.load()
    with TemporaryDirectory() as scratch:
        report = Path(scratch) / "report.json"
        measured.json_report(outfile=str(report))
        for package, share in sorted(percentages(json.loads(report.read_text())["files"]).items()):
            print(f"{package:30}{share:6.1f} %")
