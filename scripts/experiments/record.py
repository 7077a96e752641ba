"""Recording of planning runs, for servers that wait: solves OMPL problems and writes down how much work each run was.

I/O: reads the problems, appends to one JSON file. A run's work is the number of states that the planner checked. That
number does not depend on what else the machine does, so the recording can run in the background.

    nice .venv/bin/python scripts/experiments/record.py --problem Home --runs 60       # about 5 minutes of one core
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Final

import bench_path  # noqa: F401 - finds ``machine``
from machine import DATA
from planning import PROBLEMS, Problem, be_quiet
from recorded import MOST_CHECKS, RECORDING

_PATIENCE_S: Final = 100_000.0  # of the wall clock, which other work may slow: the limit is that of checks


def main() -> None:
    """Record planning runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", required=True, choices=list(PROBLEMS))
    parser.add_argument("--planner", default="RRTConnect", help="class in ompl.geometric (default: %(default)s)")
    parser.add_argument("--runs", type=int, default=20, help="how many to add (default: %(default)s)")
    parser.add_argument("--meshes", type=Path, default=DATA / "planning", help="folder of the problems")
    parser.add_argument("--out", type=Path, default=RECORDING, help="the file to add to")
    options = parser.parse_args()
    problem, planner, out = options.problem, options.planner, options.out
    be_quiet()
    solved = Problem.load(options.meshes, problem)
    for _ in range(options.runs):
        checks = min(solved.solve(planner, _PATIENCE_S, lambda: False, MOST_CHECKS).checks, MOST_CHECKS)
        recording = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
        kept = recording.setdefault(problem, {"planner": planner, "checks": []})
        if kept["planner"] != planner:
            parser.error(f"the runs of {problem} in {out} are of {kept['planner']}")
        kept["checks"].append(checks)
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(each)}" for name, each in recording.items())
        out.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        print(f"{problem}: {checks} checks" + (", not solved" if checks == MOST_CHECKS else ""), flush=True)


if __name__ == "__main__":
    main()
