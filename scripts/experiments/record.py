"""Recording of planning runs, for servers that wait: solves OMPL problems and writes down how much work each run was.

I/O: reads the problems, appends to one JSON file. A run's work is the number of states that the planner checked. That
number does not depend on what else the machine does, so the recording can run in the background. The processor time
is recorded too.

    nice .venv/bin/python scripts/experiments/record.py --problem Home --runs 60       # about 5 minutes of one core
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Final

from planning import PROBLEMS, Problem, be_quiet
from preconditions import DATA
from recorded import RECORDING

PLANNER: Final = "RRTConnect"
LIMIT_S: Final = 1_000.0  # limit by the wall clock; the paper's 100 s are applied when the recording is used


def main() -> None:
    """Record planning times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", required=True, choices=list(PROBLEMS))
    parser.add_argument("--runs", type=int, default=20, help="how many to add (default: %(default)s)")
    parser.add_argument("--meshes", type=Path, default=DATA / "planning", help="folder of the problems")
    parser.add_argument("--out", type=Path, default=RECORDING, help="the file to add to")
    options = parser.parse_args()
    problem: str = options.problem
    out: Path = options.out
    be_quiet()
    solved = Problem.load(options.meshes, problem)
    for _ in range(options.runs):
        begun_s = time.process_time()
        found = solved.solve(PLANNER, LIMIT_S, lambda: False)
        took_s = time.process_time() - begun_s
        recording: dict[str, list[list[float]]] = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
        recording.setdefault(problem, []).append([found.checks, round(took_s, 3)])
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(each)}" for name, each in recording.items())
        out.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        print(f"{problem}: {found.checks} checks, {took_s:.2f} s of processor time", flush=True)


if __name__ == "__main__":
    main()
