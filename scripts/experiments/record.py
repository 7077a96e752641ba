"""Recording of runs, for servers that wait: how much work each run of a planner was, or how long one of DBNet took.

I/O: reads the problems, appends to one JSON file; of DBNet, writes another. A run of a planner counts the states that
it checked. That number does not depend on what else the machine does, so the recording can run in the background. A run
of DBNet is its processor time: waiting for a core does not count, what other work costs in the caches does.

    nice .venv/bin/python scripts/experiments/record.py --problem Home --runs 60       # about 5 minutes of one core
    .venv/bin/python scripts/experiments/record.py --segmentation --runs 600           # about 1 minute of one core
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Final

from bench_path import ROOT
from planning import PROBLEMS, Problem, be_quiet
from recorded import MOST_CHECKS, RECORDING, SEGMENTATION

_PLANNER: Final = "RRTConnect"
_PATIENCE_S: Final = 100_000.0  # of the wall clock, which other work may slow: the limit is that of checks


def main() -> None:
    """Record runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--problem", choices=list(PROBLEMS), help="of OMPL.app; its runs are added")
    what.add_argument("--segmentation", action="store_true", help="DBNet; its runs replace those that are there")
    parser.add_argument("--runs", type=int, default=20, help="how many (default: %(default)s)")
    options = parser.parse_args()
    if options.segmentation:
        _record_segmentation(options.runs)
    else:
        _record_planning(options.problem, options.runs)


def _record_planning(problem: str, runs: int) -> None:
    be_quiet()
    solved = Problem.load(ROOT / "scripts" / "data" / "planning", problem)
    for _ in range(runs):
        checks = min(solved.solve(_PLANNER, _PATIENCE_S, lambda: False, MOST_CHECKS).checks, MOST_CHECKS)
        recording = json.loads(RECORDING.read_text(encoding="utf-8"))
        recording.setdefault(problem, {"planner": _PLANNER, "checks": []})["checks"].append(checks)
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(each)}" for name, each in recording.items())
        RECORDING.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        print(f"{problem}: {checks} checks" + (", not solved" if checks == MOST_CHECKS else ""), flush=True)


def _record_segmentation(runs: int) -> None:
    from vision import Networks, Scene

    networks, seconds = Networks(), []
    for number in range(-1, runs):  # the first run also allocates, and is left out
        scene = Scene.draw(abs(number))
        begun_s = time.process_time()
        mask = networks.segment(scene.frame)
        seconds.append(round(time.process_time() - begun_s, 5))
        if not scene.is_covered(mask):
            sys.exit(f"error: frame {number}: the mask does not cover its words; nothing is written")
    SEGMENTATION.write_text(json.dumps(seconds[1:]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
