#!/usr/bin/env python3
"""CPU time per message at each endpoint, for the three encodings: a camera image, a laser scan, an IMU reading."""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.table import Table

from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel
from proxy.serial.serializer import Encoding, Serializer

MAKE = Path(__file__).parents[1] / "make_demo_bag.py"
TOPICS = ("/camera/image", "/scan", "/imu")


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
    return {"median": statistics.median(times), "p10": tenths[0], "p90": tenths[-1]}


def measure(repeat: int) -> list[dict[str, object]]:
    """Return a row per topic and encoding."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "demo.mcap"
        subprocess.run([sys.executable, str(MAKE), "--seconds", "1", "-o", str(bag)], check=True)
        messages = samples(bag)
    rows: list[dict[str, object]] = []
    for topic, (channel, raw) in messages.items():
        for encoding in get_args(Encoding):
            serializer = Serializer(channel, encoding)
            body = serializer.encode(raw)
            if serializer.decode(body) != raw:
                raise SystemExit(f"{topic} did not survive {encoding}")

            def encode(serializer: Serializer = serializer, raw: bytes = raw) -> object:
                return serializer.encode(raw)

            def decode(serializer: Serializer = serializer, body: bytes = body) -> object:
                return serializer.decode(body)

            rows.append(
                {
                    "topic": topic,
                    "type": channel.type_name,
                    "encoding": encoding,
                    "ros_bytes": len(raw),
                    "body_bytes": len(body),
                    "encode_ms": cpu_ms(encode, repeat),
                    "decode_ms": cpu_ms(decode, repeat),
                }
            )
    return rows


def show(rows: list[dict[str, object]]) -> None:
    """Print the table."""
    table = Table(
        "topic",
        "encoding",
        "ROS bytes",
        "body bytes",
        "encode ms",
        "decode ms",
        title="CPU per message: median (p10-p90)",
    )
    for row in rows:
        ends = [f"{end['median']:.3f}  ({end['p10']:.3f}-{end['p90']:.3f})" for end in _ends(row)]
        table.add_row(str(row["topic"]), str(row["encoding"]), str(row["ros_bytes"]), str(row["body_bytes"]), *ends)
    Console(width=max(110, Console().width)).print(table)


def _ends(row: dict[str, object]) -> list[dict[str, float]]:
    return [end for end in (row["encode_ms"], row["decode_ms"]) if isinstance(end, dict)]


def main() -> int:
    """Run the bench; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, epilog="example: scripts/bench/serial.py --repeat 500")
    parser.add_argument("--repeat", type=int, default=300, help="calls per figure (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    arguments = parser.parse_args()
    if arguments.repeat < 2:
        parser.error("--repeat: expected at least 2")
    rows = measure(arguments.repeat)
    if arguments.json:
        print(json.dumps(rows, indent=2))
    else:
        show(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
