"""FogROS G, Table I and Figure 5: the gain of a robot that computes elsewhere, and the time that the overlay adds.

    sudo .venv/bin/python scripts/experiments/offload.py               # all; writes docs/experiments/offload.*
    sudo .venv/bin/python scripts/experiments/offload.py --quick       # a few seconds: does it work?

Robot and server are nodes of ROS 2 on the first and the last machine of the ring, with its three trust domains. The
unsecured ROS 2 takes as many links over Linux bridges (``scripts/bench/ros_row.py``). ``offload_tasks.py`` describes
the tasks.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from typing import Final

from bench_path import ROOT
from experiment import Report, command_line, run_experiment
from machine import machine_state
from offload_page import CDR, CYCLONE, FAST, JSON, figures_of, panels_of
from plot import save_bars
from report import progress
from ros_row import DIRECT_DOMAIN, READY_S, Row
from skeleton import Options

from gdp.host.cgroups import Cgroup
from lab.credentials import Carried
from lab.process import LabProcess, new_run
from lab.topology import LEFT, RIGHT, ring5
from proxy.config.config import Encoding

CONTENDERS: Final = {CYCLONE: "cyclone", FAST: "fast", JSON: "fast", CDR: "fast"}  # with the middleware of its ends
ENCODINGS: Final[Mapping[str, Encoding]] = {JSON: "json", CDR: "cdr"}
ROUNDS: Final = 3
AT_ONCE: Final = 34  # requests a round that are answered without computing: the network alone
COMPUTED: Final = {"vSLAM": 34, "grasp planning": 34, "motion planning": 1}  # requests a round that are computed
ALONE: Final = {
    "vSLAM": (100, 1),
    "grasp planning": (25, 4),
    "motion planning": (1, 6),
}  # requests a robot, robots in parallel
# The paper's time on the robot over its time on the server (total less network): how much slower the robot is.
SLOWER: Final = {"vSLAM": 0.68 / 1.39, "motion planning": 161.8 / 4.292, "grasp planning": 14.0 / 0.535}
MTU: Final = 1_500
_QUICK: Final = "grasp planning"
_END: Final = str(ROOT / "scripts" / "experiments" / "offload_endpoint.py")
_ANSWER_S: Final = 200.0
_ROBOTS_READY_S: Final = 180.0
_ALONE_S: Final = 1_100.0


@dataclass(slots=True)
class Measured:
    """Times of one contender, in seconds, a value a request. ``failed``: answers that were wrong."""

    there_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    total_s: list[float] = field(default_factory=list)
    computed_s: list[float] = field(default_factory=list)
    rounds_there_s: list[float] = field(default_factory=list)  # medians of the rounds
    failed: int = 0


def measure(options: Options) -> Report:
    """Compute three tasks on the robot, and on a server at the other end of the ring."""
    from offload_tasks import TASKS

    quick: bool = options.quick
    names = [_QUICK] if quick else list(COMPUTED)
    for name in names:
        TASKS[name]()  # so that missing data are reported first
    tasks = {}
    for name in names:
        machine = {"machine": asdict(machine_state())}
        tasks[name] = {
            "network": _network(name, 1 if quick else ROUNDS, quick=quick) | machine,
            "alone": _alone(name, quick=quick) | machine,
        }
    document = {"slower": SLOWER, "tasks": tasks}
    panels = panels_of(document)
    return Report(
        "offload",
        document,
        {},
        lambda path, title: save_bars(path, title, "", panels),
        figures_of(document),
    )


def _network(name: str, rounds: int, *, quick: bool) -> dict[str, object]:
    """Let every contender carry a task, in turn, round by round."""
    from offload_tasks import TASKS

    shape = TASKS[name]()
    prefix = f"/{name.replace(' ', '_').lower()}/"
    carried = {
        source: [
            Carried(f"{prefix}{encoding}/{topic}", kind, options={"encoding": encoding})
            for encoding in ENCODINGS.values()
            for topic, kind in topics
        ]
        for source, topics in ((LEFT, shape.parts), (RIGHT, [shape.answer]))
    }
    at_once, computed = (3, 2) if quick else (AT_ONCE, COMPUTED[name])
    found = {who: Measured() for who in CONTENDERS}
    size = 0
    with new_run() as run, Row(run, carried, mtu=MTU, bridged=True, ring=ring5(MTU)) as row:
        for at in range(1, rounds + 1):
            for who, middleware in CONTENDERS.items():
                progress(f"{name}, round {at} of {rounds}: {who}")
                topics = f"{prefix}{ENCODINGS.get(who, 'direct')}/"
                orders = {"task": name, "prefix": topics, "middleware": middleware, "domain": DIRECT_DOMAIN}
                orders |= {"at_once": at_once, "count": at_once + computed}
                size = _trip(row, found[who], orders, at_once, direct=who not in ENCODINGS)
    return {
        "over": "the ring of three domains",
        "request_bytes": size,
        "rounds": rounds,
        "answered_at_once": rounds * at_once,
        "computed": rounds * computed,
        "contenders": {who: {key: _short(value) for key, value in asdict(each).items()} for who, each in found.items()},
    }


def _trip(row: Row, found: Measured, orders: Mapping[str, object], at_once: int, *, direct: bool) -> int:
    """Run one series between a robot and a server; return the size of a request, in bytes."""
    there_s = []
    with row.process(RIGHT, "cloud", [_END, "cloud", json.dumps(orders)], direct=direct) as cloud:
        cloud.read(READY_S)
        with row.process(LEFT, "robot", [_END, "robot", json.dumps(orders)], direct=direct) as robot:
            size: int = robot.read(READY_S)["request_bytes"]
            while "number" in (said := robot.read(_ANSWER_S)):
                number, asked_s, answered_s = said["number"], said["asked_s"], said["answered_s"]
                while (other := cloud.read(READY_S))["number"] != number:
                    pass  # greetings
                found.failed += not said["is_right"]
                arrived_s, computed_s = other["arrived_s"], other["computed_s"]
                if number <= at_once:
                    there_s.append(arrived_s - asked_s)
                    found.back_s.append(answered_s - computed_s)
                else:
                    found.total_s.append(answered_s - asked_s)
                    found.computed_s.append(computed_s - arrived_s)
    found.there_s += there_s
    found.rounds_there_s.append(statistics.median(there_s))
    return size


def _alone(name: str, *, quick: bool) -> dict[str, object]:
    """Let robots compute by themselves, each in a control group that is slower than a core by the paper's ratio."""
    count, robots = (1, 1) if quick else ALONE[name]
    cores = 1 / SLOWER[name] if SLOWER[name] > 1 and not quick else 1.0
    times, failed = [], 0
    with new_run() as run, ExitStack() as stack:
        started = []
        for number in range(robots):
            argv = [sys.executable, _END, "alone", json.dumps({"task": name, "count": count})]
            started.append(stack.enter_context(LabProcess(run, f"robot {number}", argv)))
        for number, robot in enumerate(started):
            robot.read(_ROBOTS_READY_S)
            if cores < 1:
                group = Cgroup(f"gdp-{run.id}-robot{number}")
                stack.callback(group.remove)
                group.make()
                group.add(robot.pid)
                group.limit_cpu(cores)
        for robot in started:
            os.kill(robot.pid, signal.SIGUSR1)
        for robot in started:
            for _ in range(count):
                said = robot.read(_ALONE_S)
                times.append(said["took_s"])
                failed += not said["is_right"]
            progress(f"{name}, on the robot: {len(times)} of {count * robots}")
    return {"cores": cores, "took_s": _short(times), "failed": failed, "side_by_side": robots}


def _short(value: object) -> object:
    return [round(each, 6) for each in value] if isinstance(value, list) else value


if __name__ == "__main__":
    run_experiment(command_line(__doc__), measure)
