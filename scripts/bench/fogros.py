"""Network time of the tasks of FogROS G's Table I and Figure 5: the wait of a robot when a cloud computes for it.

    vSLAM              two images of 640 x 480 there (1.5 MB), a pose back
    motion planning    two meshes and a request there (128 kB), a path back
    grasp planning     a depth image and its mask there (1 MB), a grasp back

Both ends are ordinary rclpy nodes. They are joined by one cable (``direct``), and by proxies and three kernel switches,
in turn, round by round. Nothing is computed, so a time is that of the network, both ways. ``fogros_tasks.py`` states
the source of the sizes. ``scripts/experiments/offload.py`` computes the tasks, and compares the paper's figures with
ours.

    sudo .venv/bin/python scripts/bench/fogros.py                     # the whole; writes docs/benchmarks/fogros.*
    sudo .venv/bin/python scripts/bench/fogros.py --quick --no-save   # a few seconds: does it work?
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

from fogros_tasks import TASKS, Task
from report import Rounds, Target
from ros_row import RIGHT, Carried, Row
from ros_stage import DIRECT, MEDIAN, Bench, Call, Measured, Options, Turn, main

from proxy.config.config import Encoding

MODULE: Final = "ros_tasks"
COUNTS: Final = {"requests": "requests", "a request, B": "bytes"}
ENCODINGS: Final[tuple[Encoding, ...]] = ("cdr", "json")
MTUS: Final = (1_500, 9_000)
_DONE_S: Final = 30.0


def measure(task: Task, seconds: float, row: Row, encoding: Encoding | None, number: int) -> Measured:
    """Return the robot's report, and the cores that the proxies used.

    Raises:
        FailedError: a node did not come up.
    """
    del number
    call = Call(MODULE, "cloud", "robot", seconds, _DONE_S)
    return call.measure(row, direct=encoding is None, task=task.name, prefix=prefix_of(task, encoding or "cdr"))


def prefix_of(task: Task, encoding: Encoding) -> str:
    """Return the prefix of the names of a task's topics, where proxies carry it so."""
    return f"/{task.name.replace(' ', '_').lower()}_{encoding}/"


def case_of(task: Task, mtu: int) -> str:
    """Return the name of a case."""
    return f"{task.name}, MTU {mtu}"


def carried_of(task: Task, encoding: Encoding) -> Iterator[Carried]:
    """Return the topics of a task that the proxies carry."""
    prefix = prefix_of(task, encoding)
    for part in task.parts:
        yield Carried(prefix + part.topic, part.type_name, encoding)
    yield Carried(prefix + task.answer.topic, task.answer.type_name, encoding, source=RIGHT)


def targets_of(over: Rounds, mtu: int) -> list[Target]:
    """Return what the overlay adds, by task; there is no bound."""
    targets = []
    for task in TASKS:
        case = case_of(task, mtu)
        for who in (f"overlay, {encoding}" for encoding in ENCODINGS):
            targets.append(over.difference(f"{case}: {who} - {DIRECT}, ms", who, DIRECT, case, MEDIAN, None))
            targets.append(over.ratio(f"{case}: {who} / {DIRECT}", who, DIRECT, case, MEDIAN, None))
    return targets


def bench_of(options: Options) -> Bench:
    """Return the bench that the command line selects."""
    turns = [
        Turn(case_of(task, mtu), mtu, encoding, COUNTS, partial(measure, task, options.seconds))
        for mtu in options.mtus
        for task in TASKS
        for encoding in (None, *ENCODINGS)
    ]
    carried = [each for task in TASKS for encoding in ENCODINGS for each in carried_of(task, encoding)]
    return Bench("fogros", "What a robot waits for the network: three tasks of FogROS G", carried, turns, targets_of)


if __name__ == "__main__":
    main(bench_of, __doc__, seconds=2.0, mtus=MTUS, quick_s=1.0)
