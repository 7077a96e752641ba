"""Bench of real ROS 2 nodes over three machines: an rclpy talker, a proxy, three kernel switches, a proxy, a listener.

    text         100 bytes in CDR, 100 a second: each process sleeps in between
    quick text   the same, 500 a second
    image        640 x 480, rgb8: 921,600 bytes, 30 a second
    small        text on 20 topics, in bursts of 20 every 5 ms: 4,000 a second

Each is compared with the same two nodes joined by one cable (``direct``), in turn, round by round. Latencies are one
way, by the wall clock of the one machine. Targets: text at most 1 ms more than direct, images at most 3 ms, both
proxies together on at most one core, and no loss. In the first round ``image`` and ``small`` run for a minute.

    sudo .venv/bin/python scripts/bench/ros.py                     # the whole; writes docs/benchmarks/ros.*
    sudo .venv/bin/python scripts/bench/ros.py --quick --no-save   # a few seconds each: does it work?
    sudo .venv/bin/python scripts/bench/ros.py --rounds 1 --seconds 60 --mtu 1500 --no-save
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from peers.process import FailedError
from plot import Panel, panel_of
from report import Rounds, Target
from ros_row import LEFT, READY_S, RIGHT, Carried, Row
from ros_stage import DIRECT, Bench, Options, Turn, parse, perform

from proxy.config.config import Encoding

MODULE: Final = "ros_topics"
LOST: Final = "lost"
TWICE: Final = "twice"
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
CORES: Final = "both proxies, cores"
TEXT, QUICK, IMAGE, SMALL = "text", "quick", "image", "small"
SMALL_TOPICS: Final = 20
ENCODINGS: Final[Mapping[str, tuple[Encoding, ...]]] = {
    TEXT: ("cdr", "json"),
    QUICK: ("cdr",),
    IMAGE: ("cdr",),
    SMALL: ("cdr",),
}
EVERY_S: Final = {TEXT: 0.01, QUICK: 0.002, IMAGE: 1 / 30, SMALL: 0.005}
STRING: Final = "std_msgs/msg/String"
TYPES: Final = {TEXT: STRING, QUICK: STRING, IMAGE: "sensor_msgs/msg/Image", SMALL: STRING}
WHAT: Final = {
    TEXT: "text, 100 B, 100/s",
    QUICK: "quick text, 100 B, 500/s",
    IMAGE: "image, 921,600 B, 30/s",
    SMALL: "small, 100 B, 4,000/s on 20 topics",
}
SHORT: Final = (TEXT, QUICK)  # never longer than ``--seconds``
MTUS: Final = (1_500, 9_000)
SECONDS: Final = 6.0
LONG_S: Final = 60.0
QUICK_S: Final = 2.0
_DONE_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class Stream:
    """Messages from a talker to a listener. ``encoding``: how proxies carry them; None: they go directly."""

    kind: str
    encoding: Encoding | None
    seconds: float
    first_s: float

    @property
    def contender(self) -> str:
        """Return the row of its figures."""
        return DIRECT if self.encoding is None else f"overlay, {self.encoding}"

    def measure(self, row: Row, round_number: int) -> dict[str, float]:
        """Return the figures of one trial, by column.

        Raises:
            FailedError: a node did not come up, or nothing came.
        """
        seconds = self.first_s if round_number == 1 else self.seconds
        every_s, is_direct = EVERY_S[self.kind], self.encoding is None
        topics = topics_of(self.kind, self.encoding or "cdr")
        reported = {"kind": self.kind, "topics": topics, "count": round(seconds / every_s), "every_s": every_s}
        with (
            row.node(RIGHT, MODULE, "listen", direct=is_direct, **reported) as listener,
            row.node(LEFT, MODULE, "talk", direct=is_direct, **reported) as talker,
        ):
            listener.read(READY_S)
            cpu_s = row.proxies_cpu_s()
            os.kill(talker.pid, signal.SIGUSR1)
            said = listener.read(seconds + _DONE_S)
            cpu_s = row.proxies_cpu_s() - cpu_s
        figures = {key: value for key, value in said.items() if isinstance(value, int | float)}
        if "p50_s" not in figures:
            raise FailedError("nothing came")
        found = {LOST: figures["lost"], TWICE: figures["twice"]}
        found |= {MEDIAN: 1e3 * figures["p50_s"], P99: 1e3 * figures["p99_s"]}
        return found if is_direct else {**found, CORES: cpu_s / seconds}


def topics_of(kind: str, encoding: Encoding) -> list[str]:
    """Return the topics of a kind of stream."""
    return [f"/{kind}{at}_{encoding}" for at in range(SMALL_TOPICS if kind == SMALL else 1)]


def case_of(kind: str, mtu: int) -> str:
    """Return the name of a case."""
    return f"{WHAT[kind]}, MTU {mtu}"


def bench_of(options: Options) -> Bench:
    """Return the bench that the command line selects."""
    carried = [
        Carried(topic, TYPES[kind], encoding)
        for kind, encodings in ENCODINGS.items()
        for encoding in encodings
        for topic in topics_of(kind, encoding)
    ]
    return Bench(
        "ros",
        "Real ROS 2 nodes over three kernel switches",
        carried,
        [turn for mtu in options.mtus for turn in turns_of(options, mtu)],
        lambda over: [target for mtu in options.mtus for target in targets_of(over, mtu)],
        lambda over: [panel for mtu in options.mtus for panel in panels_of(over, mtu)],
        {"seconds of image and small in round 1": first_s(options)},
    )


def first_s(options: Options) -> float:
    """Return the seconds for which images and small messages run in the first round."""
    return float(options.seconds) if options.quick else max(float(options.seconds), LONG_S)


def kinds_of(options: Options, mtu: int) -> tuple[str, ...]:
    """Return the kinds to measure at an MTU: small messages, which fit any, only at the first."""
    return (TEXT, QUICK, IMAGE, SMALL) if mtu == options.mtus[0] else (IMAGE,)


def turns_of(options: Options, mtu: int) -> Iterator[Turn]:
    """Return the turns of a round at one MTU."""
    for kind in kinds_of(options, mtu):
        for encoding in (None, *ENCODINGS[kind]):
            long_s = options.seconds if kind in SHORT or encoding is None else first_s(options)
            stream = Stream(kind, encoding, options.seconds, long_s)
            columns = [MEDIAN, P99, LOST, TWICE, *([] if encoding is None else [CORES])]
            yield Turn(case_of(kind, mtu), stream.contender, mtu, columns, stream.measure)


def targets_of(over: Rounds, mtu: int) -> list[Target]:
    """Return the targets at one MTU."""
    targets = []
    for kind, added_ms in ((TEXT, 1.0), (QUICK, 1.0), (IMAGE, 3.0), (SMALL, None)):
        case = case_of(kind, mtu)
        for encoding in ENCODINGS[kind]:
            who = f"overlay, {encoding}"
            if case not in over.cases():
                continue
            targets.append(over.difference(f"{case}: {who} - {DIRECT}, ms", who, DIRECT, case, MEDIAN, added_ms))
            targets.append(over.target(f"{case}: {who}, {LOST}", who, case, LOST, 0.0, at_most=True))
            if kind in (IMAGE, SMALL):
                cores = 1.0 if kind == IMAGE else None
                targets.append(over.target(f"{case}: {who}, {CORES}", who, case, CORES, cores, at_most=True))
    return targets


def panels_of(over: Rounds, mtu: int) -> list[Panel]:
    """Return a panel for each case: medians, whiskers to the p99."""
    panels = []
    for kind in WHAT:
        ours = [f"overlay, {encoding}" for encoding in ENCODINGS[kind]]
        panels.append(panel_of(over, case_of(kind, mtu), MEDIAN, [*ours, DIRECT], p99=P99, ours=ours))
    return panels


def main() -> None:
    """Run the bench."""
    options = parse(__doc__ or "", rounds=3, seconds=SECONDS, mtus=MTUS, quick_s=QUICK_S)
    perform(bench_of(options), options)


if __name__ == "__main__":
    main()
