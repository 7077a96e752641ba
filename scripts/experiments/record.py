"""Recording of planning runs, for servers that wait: solves OMPL problems and writes down how much work each run was.

I/O: reads the problems, appends to one JSON file. A run's work is the number of states that the planner checked. That
number does not depend on what else the machine does, so the recording can run in the background. The processor time
is recorded too.

    nice .venv/bin/python scripts/experiments/record.py --problem Home --runs 60       # about 5 minutes of one core
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Final

import typer
from bench_path import ROOT
from planning import Problem, be_quiet
from recorded import RECORDING

__all__: list[str] = []

PLANNER: Final = "RRTConnect"
LIMIT_S: Final = 1_000.0  # limit by the wall clock; the paper's 100 s are applied when the recording is used
MESHES: Final = ROOT.parent / "shared" / "data" / "planning"

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(epilog="Example: nice .venv/bin/python scripts/experiments/record.py --problem Home --runs 60")
def main(
    problem: Annotated[str, typer.Option(help="Home, Cubicles or Twistycool.")],
    runs: Annotated[int, typer.Option(min=1, help="How many to add.")] = 20,
    meshes: Annotated[Path, typer.Option(help="Folder of the problems.")] = MESHES,
    out: Annotated[Path, typer.Option(help="The file to add to.")] = RECORDING,
) -> None:
    """Record planning times."""
    be_quiet()
    solved = Problem.load(meshes, problem)
    for _ in range(runs):
        begun_s = time.process_time()
        found = solved.solve(PLANNER, LIMIT_S, lambda: False)
        took_s = time.process_time() - begun_s
        recording: dict[str, list[list[float]]] = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
        recording.setdefault(problem, []).append([found.checks, round(took_s, 3)])
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(each)}" for name, each in recording.items())
        out.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        print(f"{problem}: {found.checks} checks, {took_s:.2f} s of processor time", flush=True)


if __name__ == "__main__":
    app()
