"""Bench of real ROS 2 nodes over three machines: an rclpy talker, a proxy, three kernel switches, a proxy, a listener.

    text         100 bytes in CDR, 100 a second: each process sleeps in between
    quick text   the same, 500 a second
    image        640 x 480, rgb8: 921,600 bytes, 30 a second
    small        text on 20 topics, in bursts of 20 every 5 ms: 4,000 a second

Each is compared with the same two nodes joined by one cable (``direct``), in turn, round by round. Latencies are one
way, by the wall clock of the one machine. Targets: text at most 0.5 ms more than direct, images at most 2 ms at MTU
9000 and 4 ms at 1500, both proxies together on at most one core, and no loss. In the first round ``image`` and
``small`` run for a minute.

    sudo .venv/bin/python scripts/bench/ros.py                     # the whole; writes docs/benchmarks/ros.*
    sudo .venv/bin/python scripts/bench/ros.py --quick --no-save   # a few seconds each: does it work?
    sudo .venv/bin/python scripts/bench/ros.py --rounds 1 --seconds 60 --mtu 1500 --no-save
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final

from report import Rounds, Target
from ros_row import READY_S, Carried, Row
from ros_stage import CORES, DIRECT, MEDIAN, Bench, Measured, Turn, main
from skeleton import Options

from lab.topology import LEFT, RIGHT
from proxy.config.config import Encoding

MODULE: Final = "ros_topics"
LOST: Final = "lost"
COUNTS: Final = {LOST: "lost", "twice": "twice"}
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
LONG_S: Final = 60.0
_DONE_S: Final = 30.0


def measure(kind: str, seconds: float, first_s: float, row: Row, encoding: Encoding | None, number: int) -> Measured:
    """Return the listener's report, and the cores that the proxies used.

    ``first_s``: seconds of the first round. Raises ``FailedError``: a node did not come up.
    """
    seconds = first_s if number == 1 else seconds
    every_s, is_direct = EVERY_S[kind], encoding is None
    topics = topics_of(kind, encoding or "cdr")
    settings = {"kind": kind, "topics": topics, "count": round(seconds / every_s), "every_s": every_s}
    with (
        row.node(RIGHT, MODULE, "listen", direct=is_direct, **settings) as listener,
        row.node(LEFT, MODULE, "talk", direct=is_direct, **settings) as talker,
    ):
        listener.read(READY_S)
        cpu_s = row.proxies_cpu_s()
        os.kill(talker.pid, signal.SIGUSR1)
        said = listener.read(seconds + _DONE_S)
        return said, (row.proxies_cpu_s() - cpu_s) / seconds


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
    turns = [turn for mtu in options.mtus for turn in turns_of(options, mtu)]
    settings = {"seconds of image and small in round 1": first_s(options)}
    return Bench("ros", "Real ROS 2 nodes over three kernel switches", carried, turns, targets_of, settings)


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
            yield Turn(case_of(kind, mtu), mtu, encoding, COUNTS, partial(measure, kind, options.seconds, long_s))


def targets_of(over: Rounds, mtu: int) -> list[Target]:
    """Return the targets at one MTU."""
    targets = []
    image_ms = 2.0 if mtu >= 9_000 else 4.0
    for kind, added_ms in ((TEXT, 0.5), (QUICK, 0.5), (IMAGE, image_ms), (SMALL, None)):
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


if __name__ == "__main__":
    main(bench_of, __doc__, seconds=6.0, mtus=MTUS, quick_s=2.0)
