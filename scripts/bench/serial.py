"""CPU time per message at each endpoint, for the three encodings: a camera image, a laser scan, an IMU reading.

.venv/bin/python scripts/bench/serial.py --repeat 500
"""

from __future__ import annotations

import gc
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final, get_args

from peers.process import FailedError
from report import Rounds
from skeleton import Options, Outcome, command_line, run_bench

from gdp.host.run_registry import RunRegistry
from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel
from proxy.serial.serializer import Encoding, Serializer

MAKE: Final = Path(__file__).parents[1] / "make_demo_bag.py"
TOPICS: Final = ("/camera/image", "/scan", "/imu")


def samples(bag_path: Path) -> dict[str, tuple[Channel, bytes]]:
    """Return one message of each topic."""
    found: dict[str, tuple[Channel, bytes]] = {}
    with BagReader(bag_path) as bag:
        for message in bag.messages():
            channel = bag.channels[message.channel]
            found[channel.topic] = (channel, message.raw)
    return {topic: found[topic] for topic in TOPICS if topic in found}


def cpu_ms(work: Callable[[], object], repeat: int) -> dict[str, float]:
    """Return median and the 10th and 90th percentile of one call's CPU time in this thread."""
    for _ in range(10):
        work()
    times = []
    gc.disable()
    for _ in range(repeat):
        start = time.thread_time_ns()
        work()
        times.append((time.thread_time_ns() - start) / 1e6)
    gc.enable()
    tenths = statistics.quantiles(times, n=10)
    return {"p10": tenths[0], "p50": statistics.median(times), "p90": tenths[-1]}


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Encode and decode a message of each topic in each encoding.

    Raises:
        FailedError: a message changed.
    """
    del runs
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "demo.mcap"
        subprocess.run([sys.executable, str(MAKE), "--seconds", "1", "-o", str(bag)], check=True)
        messages = samples(bag)
    over = Rounds()
    for topic, (channel, raw) in messages.items():
        case = f"{topic}, {len(raw):,} B in ROS"
        for encoding in get_args(Encoding):
            serializer = Serializer(channel, encoding)
            body = serializer.encode(raw)
            if serializer.decode(body) != raw:
                raise FailedError(f"{topic} did not survive {encoding}")
            over.add(encoding, case, "body, B", len(body))
            for what, work in ("encode", partial(serializer.encode, raw)), ("decode", partial(serializer.decode, body)):
                for share, value in cpu_ms(work, options.repeat).items():
                    over.add(encoding, case, f"{what} {share}, ms", value)
    settings = {"calls of a figure": options.repeat}
    return Outcome("serial", "CPU time of a message at each end", over, [], settings, is_whole=False)


if __name__ == "__main__":
    parser = command_line(__doc__, has_record=True)
    parser.add_argument("--repeat", type=int, default=300, help="calls per figure, at least 2 (default: %(default)s)")
    run_bench(parser, measure)
