"""Bench of real ROS 2 nodes over three machines: rclpy nodes, a proxy at either end, three kernel switches between.

    text          100 bytes in CDR, 100 a second: each process sleeps in between
    image         640 x 480, rgb8: 921,600 bytes, 30 a second
    small         text on 20 topics, in bursts of 20 every 5 ms: 4,000 a second

With --calls it is a service instead:

    one at a time    a client calls, waits for the answer, calls again: how long a call takes
    1,000/s          50 clients in one node call in turn, none waits for the others: whether all are answered

The row ``overlay, cdr, session`` has ``sign: session`` in its rules: a key of the two proxies, no signature.

Each is compared with the same two nodes joined by one cable (``direct``), in turn, round by round. Latencies of topics
are one way, by the wall clock of the one machine. Targets: text at most 0.5 ms more than direct, images at most 2 ms at
MTU 9000 and 4 ms at 1500, a call at most 1.5 ms, both proxies together on at most one core, and no loss. In the first
round ``image`` and ``small`` run for a minute.

    sudo .venv/bin/python scripts/bench/ros.py                     # topics; writes docs/benchmarks/ros.*
    sudo .venv/bin/python scripts/bench/ros.py --calls             # a service; writes docs/benchmarks/services.*
    sudo .venv/bin/python scripts/bench/ros.py --quick --no-save   # a few seconds each: does it work?
    sudo .venv/bin/python scripts/bench/ros.py --rounds 1 --seconds 60 --mtu 1500 --no-save
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from plot import panels_of
from report import Rounds, Target
from ros_row import READY_S, Row
from skeleton import Options, Outcome, Recorder, Trial, command_line, parse, perform

from lab.credentials import Carried
from lab.dds import BUFFER_BYTES
from lab.process import FailedError, new_run
from lab.topology import LEFT, RIGHT

DIRECT, OVERLAY, SESSION = "direct", "overlay, cdr", "overlay, cdr, session"
MEDIAN, P99, CORES, LOST = "p50, ms", "p99, ms", "both proxies, cores", "lost"
UNANSWERED, WRONG = "not answered", "answered wrongly"
MTUS: Final = (1_500, 9_000)
LONG_S: Final = 60.0
CLIENTS, RATE = 50, 1_000
ONE, LOAD = "one at a time", f"{RATE:,} calls/s from {CLIENTS} clients"
SERVICES: Final = {DIRECT: "/lamp", OVERLAY: "/lamp", SESSION: "/lamp_session"}
CALL_MS: Final = 1.5
_DONE_S: Final = 40.0
_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")


@dataclass(frozen=True, slots=True)
class Stream:
    """Topics of one kind, on each of which a message is published every ``every_s`` seconds.

    ``added_ms``: asked of the overlay at most, by MTU. ``is_short``: never longer than ``--seconds``.
    """

    what: str
    type_name: str
    topics: tuple[str, ...]
    every_s: float
    added_ms: Mapping[int, float]
    is_short: bool = False


_TEXT, _IMAGE = "std_msgs/msg/String", "sensor_msgs/msg/Image"
STREAMS: Final[Mapping[str, Stream]] = {
    "text": Stream("text, 100 B, 100/s", _TEXT, ("/text",), 0.01, dict.fromkeys(MTUS, 0.5), is_short=True),
    "image": Stream("image, 921,600 B, 30/s", _IMAGE, ("/image",), 1 / 30, {1_500: 4.0, 9_000: 2.0}),
    "small": Stream("small, 100 B, 4,000/s on 20 topics", _TEXT, tuple(f"/small{at}" for at in range(20)), 0.005, {}),
}
_CDR: Final = {"encoding": "cdr"}
CARRIED: Final = {
    LEFT: [Carried(topic, each.type_name, options=_CDR) for each in STREAMS.values() for topic in each.topics],
    RIGHT: [
        Carried(SERVICES[OVERLAY], "std_srvs/srv/SetBool", "service", _CDR),
        Carried(SERVICES[SESSION], "std_srvs/srv/SetBool", "service", {**_CDR, "sign": "session"}),
    ],
}


def case_of(what: str, mtu: int) -> str:
    """Return the name of a case."""
    return f"{what}, MTU {mtu}"


def kinds_of(options: Options, mtu: int) -> tuple[str, ...]:
    """Return the kinds of streams to measure at an MTU: images, and at the first MTU also what fits any."""
    return tuple(STREAMS) if mtu == options.mtu[0] else ("image",)


def measure_stream(row: Row, kind: str, who: str, options: Options, number: int) -> dict[str, float]:
    """Return the figures of one stream in a round, by column. Raises ``FailedError``: nothing was received."""
    stream, is_direct = STREAMS[kind], who == DIRECT
    is_long = number == 1 and not (stream.is_short or is_direct or options.quick)
    seconds = max(options.seconds, LONG_S) if is_long else options.seconds
    count = round(seconds / stream.every_s)
    settings = {"kind": kind, "topics": stream.topics, "count": count, "every_s": stream.every_s}
    with (
        row.node(RIGHT, "ros_topics", "listen", direct=is_direct, **settings) as listener,
        row.node(LEFT, "ros_topics", "talk", direct=is_direct, **settings) as talker,
    ):
        listener.read(READY_S)  # every topic is received
        cpu_s = row.proxies_cpu_s()
        talker.send(signal.SIGUSR1)
        said = listener.read(seconds + _DONE_S)
        used = (row.proxies_cpu_s() - cpu_s) / seconds
    return _figures(said, used) | {LOST: said["lost"], "twice": said["twice"]}


def measure_calls(row: Row, case: str, who: str, options: Options, _: int) -> dict[str, float]:
    """Return the figures of the calls in a round, by column. Raises ``FailedError``: none was answered."""
    seconds, is_direct = options.seconds, who == DIRECT
    settings = {"service": SERVICES[who], "clients": CLIENTS, "rate": RATE, "count": round(RATE * seconds)}
    role = "call" if case == ONE else "load"
    with row.node(RIGHT, "ros_calls", "serve", direct=is_direct, **settings) as server:
        server.read(READY_S)
        with row.node(LEFT, "ros_calls", role, direct=is_direct, seconds=seconds, **settings) as client:
            client.read(READY_S)
            cpu_s = row.proxies_cpu_s()
            said = client.read(seconds + _DONE_S)
            used = (row.proxies_cpu_s() - cpu_s) / seconds
    return _figures(said, used) | {"calls": said["sent"], UNANSWERED: said["lost"], WRONG: said["wrong"]}


def _figures(said: Mapping[str, float], cores: float) -> dict[str, float]:
    if "p50_s" not in said:
        raise FailedError("nothing was received")
    return {MEDIAN: 1e3 * said["p50_s"], P99: 1e3 * said["p99_s"], CORES: cores}


def trials_of(rows: Mapping[int, Row], options: Options) -> Iterator[Trial]:
    """Yield the trials of a round."""
    columns: tuple[str, ...] = (
        (MEDIAN, P99, "calls", UNANSWERED, WRONG) if options.calls else (MEDIAN, P99, LOST, "twice")
    )
    for mtu, row in rows.items():
        for case in (ONE, LOAD) if options.calls else kinds_of(options, mtu):
            what = case if options.calls else STREAMS[case].what
            for who in SERVICES if options.calls else (DIRECT, OVERLAY):
                work = partial(measure_calls if options.calls else measure_stream, row, case, who, options)
                yield Trial(case_of(what, mtu), who, (*columns, *([] if who == DIRECT else [CORES])), work)


def targets_of(over: Rounds, options: Options) -> list[Target]:
    """Return the targets of the overlay."""
    return [
        target for mtu in options.mtu for target in (_call_targets if options.calls else _targets)(over, options, mtu)
    ]


def _targets(over: Rounds, options: Options, mtu: int) -> Iterator[Target]:
    for kind in kinds_of(options, mtu):
        stream, case = STREAMS[kind], case_of(STREAMS[kind].what, mtu)
        added_ms = stream.added_ms.get(mtu)
        yield over.difference(f"{case}: {OVERLAY} - {DIRECT}, ms", OVERLAY, DIRECT, case, MEDIAN, added_ms)
        yield over.target(f"{case}: {OVERLAY}, {LOST}", OVERLAY, case, LOST, 0.0, at_most=True)
        if not stream.is_short:
            cores = 1.0 if kind == "image" else None
            yield over.target(f"{case}: {OVERLAY}, {CORES}", OVERLAY, case, CORES, cores, at_most=True)


def _call_targets(over: Rounds, _: Options, mtu: int) -> Iterator[Target]:
    one, load = case_of(ONE, mtu), case_of(LOAD, mtu)
    yield over.difference(f"{one}: {OVERLAY} - {DIRECT}, ms", OVERLAY, DIRECT, one, MEDIAN, CALL_MS)
    for column in (UNANSWERED, WRONG):
        yield over.target(f"{load}: {OVERLAY}, {column}", OVERLAY, load, column, 0.0, at_most=True)


def measure(options: Options) -> Outcome:
    """Measure every case, round by round, on a row of its own for each MTU."""
    recorder = Recorder()
    with ExitStack() as stack:
        rows = {}
        for mtu in options.mtu:
            run = stack.enter_context(new_run())
            rows[mtu] = stack.enter_context(Row(run, CARRIED, mtu=mtu))
        recorder.interleave(list(trials_of(rows, options)), options.rounds)
    over = recorder.rounds
    name, title = ("services", "Calls of a ROS 2 service") if options.calls else ("ros", "Real ROS 2 nodes")
    settings = {
        "seconds": options.seconds,
        "socket buffers, B": min(BUFFER_BYTES, int(_RMEM_MAX.read_text(encoding="ascii"))),
        "trouble": recorder.notes or "none",
    }
    panels = panels_of(over, MEDIAN, (OVERLAY, SESSION, DIRECT), p99=P99, ours=(OVERLAY, SESSION))
    return Outcome(name, f"{title} over three kernel switches", over, targets_of(over, options), settings, panels)


def command(words: Sequence[str] | None = None) -> Options:
    """Read the command line; ``mtu`` are the selected ones, the first one also for what fits any."""
    quick = {"rounds": 1, "seconds": 2.0}
    parser = command_line(__doc__, rounds=3, seconds=6.0, quick=quick, has_record=True, has_plot=True)
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    parser.add_argument("--calls", action="store_true", help="a service in place of topics")
    options = parse(parser, words)
    options.mtu = tuple(dict.fromkeys(options.mtu or (MTUS[:1] if options.calls else MTUS)))
    return options


if __name__ == "__main__":
    perform(command(), measure)
