"""Idle bench: what commands take, and what nodes take to start and at rest: processor time and memory.

Three switches in a row, their RIB and a recorder with default settings, in namespaces; then a switch with twenty
neighbours. A start is the processor time until a node is ready. At rest neighbours exchange keepalives alone. A wake-up
is a wait of a thread that ended (voluntary context switch). Memory is PSS, in which processes share what they have in
common.

    sudo .venv/bin/python scripts/bench/idle.py --allow-load --no-save
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from machine import processor_s
from report import Rounds
from skeleton import Options, Outcome, command_line, run_bench

from lab.credentials import Carried
from lab.machine import PROGRAMS
from lab.machines import BenchNodes, Lab
from lab.process import new_run
from lab.topology import Attachment, DomainPlan, Link, Topology, chain

COMMANDS: Final = (
    "gdp --version", "gdp --help", "gdp name --kind topic --name /a", "gdp show links", "gdp topic -h",
    "gdp-switch -h", "gdp-proxy -h",
)  # fmt: skip
WALL, CPU, START, PSS = "wall, s", "CPU, s", "start CPU, s", "PSS, MB"
IDLE, WAKES = "at rest, % of a core", "at rest, wake-ups/s"
HUB: Final = "switch with 20 neighbours"
LIMITS: Final = {WALL: 0.15, START: 0.5, IDLE: 0.5, PSS: 45.0}
HUB_LIMIT: Final = 1.0
WHO: Final = "ours"
_REPEATS: Final = 5
_SETTLE_S: Final = 8.0  # until hellos come rarely

Figures = dict[str, dict[str, float]]


def command(text: str) -> dict[str, float]:
    """Return the median wall and processor time of a command."""
    folder, (program, *words), found = Path(sys.executable).parent, text.split(), []
    for _ in range(_REPEATS):
        before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        subprocess.run([folder / program, *words], capture_output=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        found.append((time.monotonic() - begun_s, cpu_s))
    return dict(zip((WALL, CPU), sorted(found)[_REPEATS // 2], strict=True))


def pss_mb(pid: int) -> float:
    """Return the memory of a process."""
    rollup = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    return int(rollup.partition("\nPss:")[2].split()[0]) / 1024


def wakes(pid: int) -> int:
    """Return how often the threads of a process have waited."""
    tasks = Path(f"/proc/{pid}/task").glob("*/status")
    texts = [each.read_text(encoding="ascii", errors="replace") for each in tasks]
    return sum(int(each.partition("\nvoluntary_ctxt_switches:")[2].split()[0]) for each in texts)


def at_rest(pids: Mapping[str, int], seconds: float) -> Figures:
    """Return the processor time and the wake-ups of processes that are left alone."""
    time.sleep(_SETTLE_S)
    before, begun_s = {name: (processor_s(pid), wakes(pid)) for name, pid in pids.items()}, time.monotonic()
    time.sleep(seconds)
    found, took_s = dict[str, dict[str, float]](), time.monotonic() - begun_s
    for name, pid in pids.items():
        busy_s, woken = before[name]
        found[name] = {IDLE: 100 * (processor_s(pid) - busy_s) / took_s, WAKES: (wakes(pid) - woken) / took_s}
    return found


def nodes(lab: Lab, seconds: float) -> Figures:
    """Return the figures of each node."""
    with BenchNodes(lab, lab.topology.nodes, plane="auto") as running:
        pids = {f"{role} {at}": each.pid for (role, at), each in running.running.items()}
        starts = {name: processor_s(pid) for name, pid in pids.items()}
        at, carried = lab.topology.attached("proxy")[0], Carried("/idle", "std_msgs/msg/String")
        file = running.credentials.proxy(at, {"import": [carried]}, record={"path": str(lab.directory / "idle.mcap")})
        proxy = lab.start(at.switch, "proxy", ["-m", PROGRAMS["proxy"], "--json", "--config", str(file)])
        proxy.read(30.0)
        pids["proxy"], starts["proxy"] = proxy.pid, processor_s(proxy.pid)
        rest = at_rest(pids, seconds)
        return {name: {START: starts[name], **rest[name], PSS: pss_mb(pid)} for name, pid in pids.items()}


def hub(lab: Lab, seconds: float) -> Figures:
    """Return the figure at rest of a switch with nineteen switches and a RIB."""
    with BenchNodes(lab, lab.topology.nodes, plane="auto") as running:
        return at_rest({HUB: running.running["switch", "hub"].pid}, seconds)


def star() -> Topology:
    """Return a switch with nineteen others and its RIB."""
    others = tuple(f"s{number}" for number in range(19))
    links = tuple(Link("hub", each) for each in others)
    return Topology(links, (DomainPlan("star", ("hub", *others)),), (Attachment("hub", "rib", "rib"),))


def measure(options: Options) -> Outcome:
    """Measure the commands, then the nodes, in each round."""
    over = Rounds()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a second start finds its modules compiled, as on any machine
    for _ in range(options.rounds):
        with new_run() as run:
            figures: Figures = {text: command(text) for text in COMMANDS} | nodes(Lab(run, chain(3)), options.seconds)
        with new_run() as run:
            figures |= hub(Lab(run, star()), options.seconds)
        for case, columns in figures.items():
            for column, value in columns.items():
                over.add(WHO, case, column, value)
    asked = [
        (case, column, HUB_LIMIT if case == HUB else limit) for case in over.cases() for column, limit in LIMITS.items()
    ]
    found = [each for each in asked if over.spread(WHO, *each[:2]) is not None]
    targets = [
        over.target(f"{case}: {column}", WHO, case, column, limit, at_most=True) for case, column, limit in found
    ]
    return Outcome("idle", "Commands and nodes at rest", over, targets, {})


if __name__ == "__main__":
    run_bench(
        command_line(__doc__, rounds=3, seconds=30.0, quick={"rounds": 1, "seconds": 10}, has_record=True), measure
    )
