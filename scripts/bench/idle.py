"""Idle bench: what commands take, and what nodes take to start and at rest: processor time and memory.

Three switches in a row, their RIB and a recorder, with default settings, in namespaces of this machine. A start is the
processor time until a node is ready. At rest neighbours exchange keepalives and nothing else; memory is that of
``smaps_rollup``, in which processes share what they have in common (PSS).

    sudo .venv/bin/python scripts/bench/idle.py --allow-load --no-save
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from machine import processor_s
from report import Rounds, progress
from skeleton import Options, Outcome, command_line, run_bench

from lab.credentials import Carried
from lab.machine import PROGRAMS
from lab.machines import BenchNodes, Lab
from lab.process import FailedError, LabProcess, new_run
from lab.topology import chain

COMMANDS: Final = ("gdp --version", "gdp --help", "gdp name --kind topic --name /a", "gdp show links", "gdp status -h")
NODES: Final = ("gdp-switch -h", "gdp-rib -h", "gdp-proxy -h")
WALL, CPU = "wall, s", "CPU, s"
START, IDLE, PSS, RSS = "start CPU, s", "at rest, % of a core", "PSS, MB", "RSS, MB"
LIMITS: Final = {WALL: 0.15, START: 0.5, IDLE: 0.5, PSS: 45.0}
WHO: Final = "ours"
_REPEATS: Final = 5
_SETTLE_S: Final = 8.0  # until hellos come rarely


def command(text: str) -> dict[str, float]:
    """Return the median wall and processor time of a command."""
    folder, (program, *words) = Path(sys.executable).parent, text.split()
    found = []
    for _ in range(_REPEATS):
        before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        subprocess.run([folder / program, *words], capture_output=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        found.append((time.monotonic() - begun_s, cpu_s))
    wall_s, cpu_s = sorted(found)[_REPEATS // 2]
    return {WALL: wall_s, CPU: cpu_s}


def memory_mb(pid: int) -> dict[str, float]:
    """Return PSS and RSS of a process."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]
    kb = {name: int(value.split()[0]) for name, _, value in (line.partition(":") for line in lines)}
    return {PSS: kb["Pss"] / 1024, RSS: kb["Rss"] / 1024}


def nodes(lab: Lab, seconds: float) -> Mapping[str, dict[str, float]]:
    """Return the figures of each node: its start, and at rest."""
    starts: dict[str, float] = {}
    with BenchNodes(lab, lab.topology.nodes, plane="auto") as running:
        found: dict[str, LabProcess] = {f"{role} {at}": each for (role, at), each in running.running.items()}
        starts |= {name: processor_s(each.pid) for name, each in found.items()}
        at = lab.topology.attached("proxy")[0]
        topic = Carried("/idle", "std_msgs/msg/String")
        file = running.credentials.proxy(at, {"import": [topic]}, record={"path": str(lab.directory / "idle.mcap")})
        proxy = found["proxy"] = lab.start(
            at.switch, "proxy", ["-m", PROGRAMS["proxy"], "--json", "--config", str(file)]
        )
        proxy.read(30.0)
        starts["proxy"] = processor_s(proxy.pid)
        time.sleep(_SETTLE_S)
        before, begun_s = {name: processor_s(each.pid) for name, each in found.items()}, time.monotonic()
        time.sleep(seconds)
        took_s = time.monotonic() - begun_s
        if ended := [name for name, each in found.items() if each.code is not None]:
            raise FailedError(f"ended: {', '.join(ended)}")
        return {
            name: {
                START: starts[name],
                IDLE: 100 * (processor_s(each.pid) - before[name]) / took_s,
                **memory_mb(each.pid),
            }
            for name, each in found.items()
        }


def measure(options: Options) -> Outcome:
    """Measure the commands, then the nodes, in each round."""
    over = Rounds()
    for number in range(1, options.rounds + 1):
        progress(f"round {number}/{options.rounds}")
        figures = {text: command(text) for text in (*COMMANDS, *NODES)}
        with new_run() as run:
            figures |= nodes(Lab(run, chain(3)), options.seconds)
        for case, columns in figures.items():
            for column, value in columns.items():
                over.add(WHO, case, column, value)
    targets = [
        over.target(f"{case}: {column}", WHO, case, column, limit, at_most=True)
        for case in over.cases()
        for column, limit in LIMITS.items()
        if over.spread(WHO, case, column) is not None
    ]
    return Outcome("idle", "Commands and nodes at rest", over, targets, {"rounds": options.rounds})


if __name__ == "__main__":
    run_bench(
        command_line(__doc__, rounds=3, seconds=30.0, quick={"rounds": 1, "seconds": 10}, has_record=True), measure
    )
