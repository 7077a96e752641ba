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
from dataclasses import dataclass
from typing import Final

from fogros_tasks import TASKS, Task
from peers.process import FailedError
from plot import panel_of
from report import Rounds, Target
from ros_row import LEFT, READY_S, RIGHT, Carried, Row
from ros_stage import DIRECT, Bench, Options, Turn, parse, perform

from proxy.config.config import Encoding

MODULE: Final = "ros_tasks"
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
REQUESTS: Final = "requests"
BYTES: Final = "a request, B"
CORES: Final = "both proxies, cores"
ENCODINGS: Final[tuple[Encoding, ...]] = ("cdr", "json")
OURS: Final = [f"overlay, {encoding}" for encoding in ENCODINGS]
MTUS: Final = (1_500, 9_000)
SECONDS: Final = 2.0
QUICK_S: Final = 1.0
_DONE_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class Trip:
    """One task. ``encoding``: how proxies carry its messages; None: they go directly."""

    task: Task
    encoding: Encoding | None
    seconds: float

    @property
    def contender(self) -> str:
        """Return the row of its figures."""
        return DIRECT if self.encoding is None else f"overlay, {self.encoding}"

    def measure(self, row: Row, round_number: int) -> dict[str, float]:
        """Return the figures of one trial, by column.

        Raises:
            FailedError: a node did not come up, or nothing was answered.
        """
        del round_number
        is_direct, prefix = self.encoding is None, prefix_of(self.task, self.encoding or "cdr")
        reported = {"task": self.task.name, "prefix": prefix, "seconds": self.seconds}
        with row.node(RIGHT, MODULE, "cloud", direct=is_direct, **reported) as cloud:
            cloud.read(READY_S)
            with row.node(LEFT, MODULE, "robot", direct=is_direct, **reported) as robot:
                begun = robot.read(READY_S)
                cpu_s = row.proxies_cpu_s()
                said = {**begun, **robot.read(self.seconds + _DONE_S)}
                cpu_s = row.proxies_cpu_s() - cpu_s
        figures = {key: value for key, value in said.items() if isinstance(value, int | float)}
        if "p50_s" not in figures:
            raise FailedError("no request was answered")
        found = {MEDIAN: 1e3 * figures["p50_s"], P99: 1e3 * figures["p99_s"]}
        found |= {REQUESTS: figures["requests"], BYTES: figures["bytes"]}
        return found if is_direct else {**found, CORES: cpu_s / self.seconds}


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


def turns_of(options: Options) -> Iterator[Turn]:
    """Return the turns of a round."""
    for mtu in options.mtus:
        for task in TASKS:
            for encoding in (None, *ENCODINGS):
                trip = Trip(task, encoding, options.seconds)
                columns = [MEDIAN, P99, REQUESTS, BYTES, *([] if encoding is None else [CORES])]
                yield Turn(case_of(task, mtu), trip.contender, mtu, columns, trip.measure)


def targets_of(over: Rounds, mtu: int) -> list[Target]:
    """Return what the overlay adds, by task; there is no bound."""
    targets = []
    for task in TASKS:
        case = case_of(task, mtu)
        for who in OURS:
            targets.append(over.difference(f"{case}: {who} - {DIRECT}, ms", who, DIRECT, case, MEDIAN, None))
            targets.append(over.ratio(f"{case}: {who} / {DIRECT}", who, DIRECT, case, MEDIAN, None))
    return targets


def bench_of(options: Options) -> Bench:
    """Return the bench that the command line selects."""
    cases = [case_of(task, mtu) for mtu in options.mtus for task in TASKS]
    return Bench(
        "fogros",
        "What a robot waits for the network: three tasks of FogROS G",
        [each for task in TASKS for encoding in ENCODINGS for each in carried_of(task, encoding)],
        list(turns_of(options)),
        lambda over: [target for mtu in options.mtus for target in targets_of(over, mtu)],
        lambda over: [panel_of(over, case, MEDIAN, [*OURS, DIRECT], p99=P99, ours=OURS) for case in cases],
    )


def main() -> None:
    """Run the bench."""
    options = parse(__doc__ or "", rounds=3, seconds=SECONDS, mtus=MTUS, quick_s=QUICK_S)
    perform(bench_of(options), options)


if __name__ == "__main__":
    main()
