"""Soak bench: growth of long-lived nodes while subscriptions and publishers come and go.

In memory (virtual time, one process): a reader subscribes and unsubscribes over and over; then publishers of unknown
names come, are read, and go. Samples: objects that Python's collector tracks, and resident memory.

On real processes in namespaces: the same for a while, at an even rate. Samples of every switch, RIB and member: open
descriptors, threads, bytes of BPF maps (which hold an entry only while it is there), resident memory.

The samples after the warm-up must be flat (``faults/slope.py``). Nodes remember ended peers up to a bound: 16,384
verified delegations a node, 4,096 ended writer proxies, withdrawals for the hour of an RtCert. A run of more publishers
takes its samples after that is full; a shorter one may grow by ``FILL_KB`` for each, and counts no objects.

    .venv/bin/python scripts/bench/soak.py --only memory                                    # a minute
    .venv/bin/python scripts/bench/soak.py --only memory --cycles 30000 --publishers 25000         # 20 minutes
    sudo .venv/bin/python scripts/bench/soak.py --only real --seconds 3600
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from faults.overlay import Overlay
from faults.plan import Churn, Flow, Plan
from faults.slope import Growth, growth_of
from machine import map_bytes, resident_bytes
from peers.process import FailedError
from report import print_table, progress
from skeleton import clean_exit, command_line, new_run
from topologies import make_topology

from gdp.client.publisher import Publisher
from gdp.simulation.simulation import Simulation
from gdp.simulation.topology import chain
from gdp.trust.right import Right
from gdp.trust.verifier import ADCERTS_REMEMBERED

CYCLES: Final = 3_000
PUBLISHERS: Final = 600
SECONDS: Final = 60.0
SAMPLES: Final = 50
BETWEEN_S: Final = 1.0
CACHES: Final = ADCERTS_REMEMBERED + 500  # publishers until every bounded memory of ended ones is full
FILL_KB: Final = 16.0  # a publisher, until then: seven delegations over six nodes, and other remembered state
FILLING: Final = "publishers of new names, while memories fill"
LEFT, RIGHT = "s1/left", "s3/right"
SHARE: Final = 0.02  # share of the mean
LEAST: Final = {"objects": 200.0, "memory, kB": 512.0, "descriptors": 0.0, "threads": 0.0, "map bytes": 1_024.0}

Samples = dict[tuple[str, str], list[float]]  # (process, figure) -> samples


class Memory:
    """Three switches, a RIB and two members on a network in memory."""

    def __init__(self) -> None:
        self._world = Simulation(
            topology=chain(3), seed=1, hello_s=20.0, dead_s=70.0
        )  # hellos cost most of the time otherwise
        if not self._world.run_until_attached():
            raise FailedError("the network in memory did not settle")
        self._names = 0

    def subscribe(self, cycles: int, samples: Samples) -> None:
        """Subscribe and unsubscribe so often, with a message read each time."""
        world, left, right = self._world, self._world.members[LEFT], self._world.members[RIGHT]
        publisher = left.advertise(world.topic("/soak", left, [Right.PUBLISH]), b"soak", reliable=True)
        topic = world.topic("/soak", right, [Right.READ])
        world.network.send_pending(LEFT)

        def once() -> None:
            right.subscribe(topic)
            world.network.send_pending(RIGHT)
            self._pass_one(publisher)
            right.unsubscribe(topic.name)
            world.network.send_pending(RIGHT)
            self._until(lambda: not publisher.readers, "the reader's end")

        _repeat("subscribe, read, unsubscribe", once, cycles, samples)
        left.withdraw(topic.name)
        world.network.send_pending(LEFT)

    def publish(self, publishers: int, samples: Samples) -> None:
        """Start so many publishers in turn, each of a name of its own; each is read once and goes."""
        world, left, right = self._world, self._world.members[LEFT], self._world.members[RIGHT]

        def once() -> None:
            self._names += 1
            name = f"/soak/{self._names}"
            publisher = left.advertise(world.topic(name, left, [Right.PUBLISH]), b"soak", reliable=True)
            topic = world.topic(name, right, [Right.READ])
            right.subscribe(topic)
            world.network.send_pending(LEFT)
            world.network.send_pending(RIGHT)
            self._pass_one(publisher)
            left.withdraw(topic.name)
            right.unsubscribe(topic.name)
            world.network.send_pending(LEFT)
            world.network.send_pending(RIGHT)
            world.network.run(BETWEEN_S)  # the names of the warm-up expire within it

        if publishers > CACHES + SAMPLES:
            _repeat("publishers until all is full", once, CACHES)
            _repeat("publishers of new names", once, publishers - CACHES, samples)
        else:
            _repeat(FILLING, once, publishers, samples)

    def _pass_one(self, publisher: Publisher) -> None:
        """Send one message to the only reader."""
        self._until(lambda: publisher.readers == 1, "a reader")
        publisher.publish(b"message")
        self._world.members[LEFT].flush(self._world.network.now.mono_s)
        self._world.network.send_pending(LEFT)
        self._until(lambda: bool(self._world.members[RIGHT].poll_messages()), "a message")

    def _until(self, is_met: Callable[[], bool], what: str) -> None:
        if not self._world.network.run(30.0, is_met):
            raise FailedError(f"{what} did not come about within 30 s")


def _repeat(label: str, once: Callable[[], None], times: int, samples: Samples | None = None) -> None:
    """Repeat an action, and take samples; where bounded memories still fill up, objects are not counted."""
    begun_s = time.monotonic()
    for at in range(times):
        once()
        if samples is not None and not (at + 1) % max(times // SAMPLES, 1):
            gc.collect()
            if label != FILLING:
                samples[label, "objects"].append(len(gc.get_objects()))
            samples[label, "memory, kB"].append(resident_bytes() / 1_024)
    progress(f"{label}: {times} in {time.monotonic() - begun_s:.0f} s")


def soak_memory(options: argparse.Namespace, samples: Samples) -> None:
    """Soak in memory.

    Raises:
        FailedError: an expected event did not occur.
    """
    memory = Memory()
    memory.subscribe(options.cycles, samples)
    memory.publish(options.publishers, samples)


def _plan() -> Plan:
    topology, members = make_topology(
        {"a": ("a1", "a2"), "b": ("b1",)}, {"b": "a"}, ("a1-a2", "a2-b1", "a1-b1"), ("a2", "b1"),
        {"P": "a1", "R": "b1", "C": "b1", "D": "a2"},
    )  # fmt: skip
    churn = (Churn("/steady", "C"), Churn("/coming", "D", publishes=True), Churn("/coming", "R"))
    return Plan(topology, members, flows=(Flow("/steady", "P", ("R",), hz=50.0),), churn=churn)


def soak_real(options: argparse.Namespace, samples: Samples) -> None:
    """Soak on real processes.

    Raises:
        FailedError: a process did not come up, or ended.
        GdpError: the kernel refuses.
    """
    with new_run() as run, Overlay(run, _plan(), plane=options.plane, churn_hz=options.hz) as overlay:
        overlay.start_all()
        progress("real processes: up")
        begun_s = time.monotonic()
        for at in range(1, SAMPLES + 1):
            time.sleep(max(begun_s + at * options.seconds / SAMPLES - time.monotonic(), 0.0))
            for who in overlay.died():
                raise FailedError(f"{who} ended by itself: {overlay.log_tail(who)}")
            for who in overlay.everybody():
                for what, value in _look(overlay.pid(who)):
                    samples[who, what].append(value)
        delivered = sum(1 for _, records in overlay.read("C") for _ in records)
        if not delivered:
            raise FailedError("the reader that comes and goes never had a message")
        progress(f"real processes: {options.seconds:g} s, {delivered} messages to the reader that comes and goes")


def _look(pid: int) -> Iterator[tuple[str, float]]:
    folder = Path(f"/proc/{pid}")
    yield "descriptors", float(len(list((folder / "fd").iterdir())))
    yield "threads", float(len(list((folder / "task").iterdir())))
    yield "memory, kB", resident_bytes(pid) / 1_024
    if maps := map_bytes(pid):
        yield "map bytes", float(maps)


def show(samples: Samples, publishers: int) -> bool:
    """Print every figure; return whether all are flat, or grew as filling memories do."""
    rows, flat = [], True
    for (who, what), values in samples.items():
        growth: Growth = growth_of(values)
        least = FILL_KB * publishers if who == FILLING else LEAST[what]
        is_flat = growth.is_flat(SHARE, least)
        flat = flat and is_flat
        figures = (f"{each:,.1f}" for each in (growth.mean, growth.rise, growth.scatter))
        rows.append((who, what, *figures, "yes" if is_flat else "NO"))
    print_table(("who", "figure", "mean", "rise", "scatter", "flat"), rows, title="After the warm-up", words=2)
    return flat


def main() -> None:
    """Run the soak; exit 1 when something grows."""
    parser = command_line(__doc__, seconds=SECONDS, seconds_of="on real processes")
    parser.add_argument("--only", choices=("memory", "real"), help="this part")
    parser.add_argument("--cycles", type=int, default=CYCLES, help="subscriptions in memory (default: %(default)s)")
    parser.add_argument("--publishers", type=int, default=PUBLISHERS, help="in memory (default: %(default)s)")
    parser.add_argument("--hz", type=float, default=10.0, help="changes a second there (default: %(default)s)")
    parser.add_argument("--plane", default="auto", help="as gdp-switch --data-plane (default: %(default)s)")
    options = parser.parse_args()
    samples: Samples = defaultdict(list)
    with clean_exit():
        if options.only != "real":
            soak_memory(options, samples)
        if options.only != "memory":
            soak_real(options, samples)
    sys.exit(not show(samples, options.publishers))


if __name__ == "__main__":
    main()
