"""How long a secured message takes over three raw switches: round trip of a small one, one way of an image.

Real processes in namespaces: A - S1 - S2 - S3 - B, with the switches and the RIB that robots run. The two ends are
members of the overlay without ROS: each message is encrypted, signed, verified, and reported on.

    sudo .venv/bin/python scripts/bench/messages.py
    sudo .venv/bin/python scripts/bench/messages.py --mtu 1500 --mtu 9000 --count 300 --json out.json
    sudo .venv/bin/python scripts/bench/messages.py --realtime     # all processes under SCHED_FIFO

Each round lays a new chain. The figures are the medians of the rounds, with their lowest and highest in brackets.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import secrets
import statistics
import struct
import subprocess
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gdp.client.member import Member, Topic
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.metadata import Metadata
from gdp.nodes.allocator import settle_memory
from gdp.nodes.config import RibConfig
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.nodes.runtime import Runtime
from gdp.ports.raw import RawPlane
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD, load_delegations
from gdp.testbed.namespaces import Namespaces
from gdp.testbed.runs import Run, Runs
from gdp.testbed.topology import Attachment, chain
from gdp.trust.right import Right
from proxy.ring.materials import Materials

SIZES = (100, 10_000, 921_600)
COLUMNS = ("RTT median ms", "RTT p99 ms", "one way median ms", "one way p99 ms", "sender CPU ms")
STAMP = struct.Struct("!Qd")
PATIENCE_S = 20.0


class End:
    """One end of the bench: publishes one topic, reads another."""

    def __init__(self, config: Path, publishes: str, reads: str) -> None:
        settings = RibConfig.load(config)  # identity, domain and iface are all that an end needs
        identity, policy = load_member(settings.identity, settings.domain, Role.PROXY)
        self.member = Member(
            identity, policy, NodeSettings(incarnation(), wall_clock_ms(), secrets.token_bytes)
        )
        self.plane = RawPlane([settings.iface])
        self.runtime = Runtime(self.member, self.plane)
        topics = {}
        for each in load_delegations(settings.identity / "delegations"):
            assert each.metadata is not None
            grants = {epoch: grant.secret for epoch, grant in each.open(identity).items()}
            topics[str(each.metadata["name"])] = Topic(each, grants)
        self.publisher = self.member.advertise(topics[publishes], b"bench", reliable=True)
        self.member.subscribe(topics[reads])

    def publish(self, message: bytes) -> None:
        """Publish and hand the frames to the device."""
        self.publisher.publish(message)
        self.member.flush(time.monotonic())
        self.runtime.flush()

    def wait_for_message(self, deadline_s: float) -> bytes | None:
        """Return the next message, or None when the deadline passed."""
        while time.monotonic() < deadline_s and not self.runtime.is_stopped:
            self.runtime.step(deadline_s)
            messages = self.member.take_messages()
            if messages:
                return messages[0].delivered.message
        return None

    def wait_for_reader(self) -> None:
        """Wait until the far end listens."""
        if not self.runtime.run(lambda: bool(self.publisher.readers), time.monotonic() + PATIENCE_S):
            sys.exit("nobody reads: the overlay did not come up")


def pong(config: Path) -> None:
    """Answer every message with the moment at which it was whole."""
    end = End(config, "/pong", "/ping")
    with end.runtime.signals():
        while not end.runtime.is_stopped:
            message = end.wait_for_message(time.monotonic() + 3600)
            if message is not None:
                number, _ = STAMP.unpack_from(message)
                end.publish(STAMP.pack(number, time.monotonic()))


def ping(config: Path, count: int) -> None:
    """Send, wait for the answer, send the next; print figures in seconds as JSON."""
    end = End(config, "/ping", "/pong")
    settle_memory()
    end.wait_for_reader()
    figures: dict[str, dict[str, list[float]]] = {}
    for size in SIZES:
        rtts: list[float] = []
        ways: list[float] = []
        cpus: list[float] = []
        repeats = count if size > 100_000 else 5 * count
        for number in range(repeats + repeats // 5):
            payload = STAMP.pack(number, 0.0) + secrets.token_bytes(size - STAMP.size)
            cpu_s, begun_s = time.process_time(), time.monotonic()
            end.publish(payload)
            answer = end.wait_for_message(begun_s + PATIENCE_S)
            ended_s = time.monotonic()
            if answer is None:
                sys.exit(f"message {number} of {size} bytes was not answered")
            echoed, whole_s = STAMP.unpack(answer)
            if echoed != number:
                sys.exit(f"answer to {echoed}, not to {number}")
            if number >= repeats // 5:  # before that, windows open
                rtts.append(ended_s - begun_s)
                ways.append(whole_s - begun_s)
                cpus.append(time.process_time() - cpu_s)
        figures[str(size)] = {"rtt_s": rtts, "one_way_s": ways, "sender_cpu_s": cpus}
    print(json.dumps({"figures": figures, "repairs": end.publisher.repairs}), flush=True)


def measure(mtu: int, count: int, runs: Runs) -> dict[str, dict[str, list[float]]]:
    """Lay a chain of three switches, measure, take it down."""
    run = runs.start()
    try:
        return _measure(mtu, count, run)
    finally:
        run.end()


def _measure(mtu: int, count: int, run: Run) -> dict[str, dict[str, list[float]]]:
    topology = chain(3, mtu)
    spaces = Namespaces(topology, run)
    materials = Materials(topology, run.directory, metrics=False)
    left, right = topology.attached("proxy")
    owner = run.directory / "owner"
    for at, publishes, reads in ((left, "/ping", "/pong"), (right, "/pong", "/ping")):
        node = run.directory / "nodes" / f"proxy-{at.switch}"
        for topic, right_to in ((publishes, Right.PUBLISH), (reads, Right.READ)):
            given = delegate(owner, node / CARD, Metadata({"kind": "topic", "name": topic}), [right_to])
            install_delegation(node, given)
    for process in [
        _start(spaces, run, node, ["-m", "gdp.cli.switch", "--json", "--config", str(materials.switch(node, "raw"))])
        for node in topology.nodes
    ]:
        _ready(process)
    for at in topology.attached("rib"):
        _ready(_start(spaces, run, at.switch, ["-m", "gdp.cli.rib", "--json", "--config", str(materials.rib(at))]))
    _start(spaces, run, right.switch, [__file__, "--as", "pong", "--config", str(_config(run, right))])
    pinger = _start(
        spaces, run, left.switch, [__file__, "--as", "ping", "--config", str(_config(run, left)), "--count", str(count)]
    )
    output, _ = pinger.communicate()
    if pinger.returncode:
        sys.exit(f"the measurement failed: {output.decode()}")
    answer = json.loads(output)
    if answer["repairs"]:
        print(f"mtu {mtu}: {answer['repairs']} parts were sent again", file=sys.stderr)
    figures: dict[str, dict[str, list[float]]] = answer["figures"]
    return figures


def _config(run: Run, at: Attachment) -> Path:
    domain = run.directory / "domains" / "chain" / "root.crt"
    root = next(iter(sorted(domain.parent.glob("*.crt"))), domain)
    path = run.directory / f"end-{at.switch}.yaml"
    node = run.directory / "nodes" / f"proxy-{at.switch}"
    path.write_text(f"identity: {node}\ndomain: {{root: {root}}}\niface: {at.ifname}\n")
    return path


def _start(spaces: Namespaces, run: Run, node: str, arguments: list[str]) -> subprocess.Popen[bytes]:
    argv = spaces.command(node, [sys.executable, *arguments])
    process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True)
    run.note_process(process.pid)
    return process


def _ready(process: subprocess.Popen[bytes]) -> None:
    assert process.stdout is not None
    if b'"ready"' not in process.stdout.readline():
        sys.exit("a node did not come up")


def _median_and_p99(ordered: list[float]) -> tuple[float, float]:
    return statistics.median(ordered), ordered[int(len(ordered) * 0.99)]


def main() -> None:
    """Run the bench, or one of its ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mtu", type=int, action="append", help="bytes after the Ethernet header; may be repeated")
    parser.add_argument("--count", type=int, default=200, help="messages of the largest size; others: five times that")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--realtime", action="store_true", help="run under SCHED_FIFO: what else runs does not disturb")
    parser.add_argument("--json", type=Path, help="write all figures here")
    parser.add_argument("--as", dest="end", choices=("ping", "pong"), help=argparse.SUPPRESS)
    parser.add_argument("--config", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.end == "ping":
        ping(options.config, options.count)
        return
    if options.end == "pong":
        pong(options.config)
        return
    if options.realtime:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    runs = Runs()
    runs.sweep()
    scheduler = "SCHED_FIFO" if options.realtime else "ordinary scheduler"
    machine = f"{platform.release()}, {os.cpu_count()} cores, {scheduler}"
    table = Table(title=f"secured messages over 3 raw switches; {machine}")
    for column in ("MTU", "bytes", *COLUMNS):
        table.add_column(column, justify="right")
    result: dict[str, dict[str, dict[str, list[float]]]] = {}
    for mtu in options.mtu or [1_500, 9_000]:
        rounds = [_summary(measure(mtu, options.count, runs)) for _ in range(options.rounds)]
        for size in rounds[0]:
            columns = {name: sorted(each[size][name] for each in rounds) for name in COLUMNS}
            result.setdefault(str(mtu), {})[size] = columns
            cells = [f"{statistics.median(c):.2f} ({c[0]:.2f}-{c[-1]:.2f})" for c in columns.values()]
            table.add_row(str(mtu), f"{int(size):,}", *cells)
    Console(width=140).print(table)
    if options.json is not None:
        options.json.write_text(json.dumps({"scheduler": scheduler, "rounds": result}, indent=2) + "\n")


def _summary(figures: dict[str, dict[str, list[float]]]) -> dict[str, dict[str, float]]:
    """Return the columns of the table in milliseconds, by message size."""
    summary = {}
    for size, figure in figures.items():
        rtt, way = sorted(figure["rtt_s"]), sorted(figure["one_way_s"])
        values = [*_median_and_p99(rtt), *_median_and_p99(way), statistics.median(figure["sender_cpu_s"])]
        summary[size] = dict(zip(COLUMNS, (value * 1e3 for value in values), strict=True))
    return summary


if __name__ == "__main__":
    main()
