"""Uplink bench: messages that are late when one of a robot's two uplinks is cut, over two paths and over one.

A robot with two uplinks, each behind a NAT of its own, has a tunnel over each to one border. It publishes two topics
of 100 bytes a hundred times a second, one with ``paths: 2`` and one with ``paths: 1``. A server behind another NAT
reads both. A cut lets all packets of one uplink vanish, so that only missing keepalives show it. The uplinks take
turns.

The delay of a message is the time from its publication to its arrival. A message is late if its delay is above the
limit: twice the longest delay of the quiet seconds before the cuts, and at least ``LIMIT_MIN_MS``, which is far below
the time until a switch detects the cut. The silence of a cut is the longest time between two messages.

    sudo .venv/bin/python scripts/bench/uplink_cut.py                  # writes docs/benchmarks/uplink_cut.json
    sudo .venv/bin/python scripts/bench/uplink_cut.py --rounds 2 --no-save
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from itertools import pairwise
from typing import Final, Literal

from peers.process import FailedError
from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, new_run, run_bench

import gdp
from gdp.host.run_registry import RunRegistry
from gdp.trust.right import Right
from internet.access import Access
from internet.laboratory import Laboratory
from internet.overlay import Overlay

UPLINKS: Final = ("wlan0", "wwan0")
TOPICS: Final[dict[str, Literal[1, 2]]] = {"one": 1, "two": 2}  # by the number of paths
HZ: Final = 100.0
TARGET_MS: Final = 300.0
LIMIT_MIN_MS: Final = 100.0
CUT_S: Final = 2.0
SETTLE_S: Final = 6.0
PATIENCE_S: Final = 60.0
LATE, SILENCE, P99, LOST, DOUBLED = "late", "silence, ms", "p99, ms", "lost", "doubled"
_NUMBER: Final = struct.Struct("!q92x")
_CASES: Final = {1: "paths: 1", 2: "paths: 2"}


class Flow:
    """A publisher and a reader in this process, each a thread, until ``close``.

    Attributes:
        sent_s: monotonic second of each message, by number.
        arrivals: monotonic second and number.
    """

    def __init__(self, publisher: gdp.Publisher, subscription: gdp.Subscription) -> None:
        self._publisher, self._subscription = publisher, subscription
        self._is_over = threading.Event()
        self.sent_s: list[float] = []
        self.arrivals: list[tuple[float, int]] = []
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._publish, self._read)]
        for thread in self._threads:
            thread.start()

    def _publish(self) -> None:
        due_s = time.monotonic()
        while not self._is_over.wait(max(due_s - time.monotonic(), 0.0)):
            self.sent_s.append(time.monotonic())
            self._publisher.put(_NUMBER.pack(len(self.sent_s) - 1))
            due_s += 1 / HZ

    def _read(self) -> None:
        while not self._is_over.is_set() or len(self.arrivals) < len(self.sent_s):
            try:
                message = self._subscription.receive(timeout_s=1.0)
            except gdp.SessionError:  # nothing came
                if self._is_over.is_set():
                    return
                continue
            self.arrivals.append((time.monotonic(), _NUMBER.unpack(message.payload)[0]))

    def delays_ms(self, from_s: float, to_s: float) -> list[float]:
        """Return the delay of each message that was published in an interval; an absent one has that until now."""
        now_s, sent = time.monotonic(), list(self.sent_s)
        came = {number: at_s for at_s, number in reversed(list(self.arrivals))}
        return [(came.get(number, now_s) - at_s) * 1e3 for number, at_s in enumerate(sent) if from_s <= at_s < to_s]

    def silence_ms(self, from_s: float, to_s: float) -> float:
        """Return the longest time between two arrivals in an interval, its ends included."""
        marks = [from_s, *(at_s for at_s, _ in list(self.arrivals) if from_s <= at_s < to_s), to_s]
        return max(after - before for before, after in pairwise(marks)) * 1e3

    def close(self) -> None:
        """Stop publishing, and read what is on its way."""
        self._is_over.set()
        for thread in self._threads:
            thread.join(PATIENCE_S)


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Cut the uplinks in turn, in one network."""
    over = Rounds()
    with new_run(runs) as run, Laboratory(run) as laboratory, ExitStack() as stack:
        flows = start(laboratory, stack)
        sites = [laboratory.sites[each] for each in UPLINKS]
        time.sleep(options.settle_s)
        quiet_s = time.monotonic()
        time.sleep(options.quiet_s)
        limits = {
            paths: max(2 * max(flow.delays_ms(quiet_s, time.monotonic() - 0.5)), LIMIT_MIN_MS)
            for paths, flow in flows.items()
        }
        silences: dict[int, list[float]] = {paths: [] for paths in flows}
        for number in range(options.rounds):
            site, since_s = sites[number % len(sites)], time.monotonic()
            site.cut()
            time.sleep(CUT_S)
            until_s = time.monotonic()
            site.restore()
            time.sleep(options.settle_s)
            for paths, flow in flows.items():
                late = sum(delay > limits[paths] for delay in flow.delays_ms(since_s, until_s))
                silences[paths].append(flow.silence_ms(since_s, until_s))
                over.add("tunnels", _CASES[paths], LATE, late)
                over.add("tunnels", _CASES[paths], SILENCE, silences[paths][-1])
                progress(f"cut {number + 1}, {_CASES[paths]}: {late} late, {silences[paths][-1]:.0f} ms")
        for paths, flow in flows.items():
            flow.close()
            numbers = [number for _, number in flow.arrivals]
            over.add("tunnels", _CASES[paths], P99, percentile(silences[paths], 0.99))
            over.add("tunnels", _CASES[paths], LOST, len(flow.sent_s) - len(set(numbers)))
            over.add("tunnels", _CASES[paths], DOUBLED, len(numbers) - len(set(numbers)))
    one, two = _CASES[1], _CASES[2]
    targets = [
        over.target("messages late after a cut, paths: 2", "tunnels", two, LATE, 0.0, at_most=True),
        over.target("silence after a cut, paths: 1, p99, ms", "tunnels", one, P99, TARGET_MS, at_most=True),
    ]
    for case in (one, two):
        targets += [
            over.target(f"messages {column}, {case}", "tunnels", case, column, 0.0, at_most=True)
            for column in (LOST, DOUBLED)
        ]
    settings = {
        "rounds": options.rounds,
        "messages": sum(len(flow.sent_s) for flow in flows.values()),
        "limit, paths: 2, ms": round(limits[2]),
    }
    return Outcome("uplink_cut", "A cut of one of two uplinks", over, targets, settings)


def start(laboratory: Laboratory, stack: ExitStack) -> dict[int, Flow]:
    """Start everything; return the two flows by their number of paths, once both have what they asked for.

    Raises:
        FailedError: the second path does not come up.
    """
    overlay = stack.enter_context(Overlay(laboratory))
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    homes = [laboratory.add_site(each, Access.PORT_RESTRICTED) for each in UPLINKS]
    robot = laboratory.add_host("robot", homes[0], UPLINKS[0])
    robot.attach(homes[1], UPLINKS[1])
    server = laboratory.add_host("server", laboratory.add_site("office", Access.PORT_RESTRICTED))
    overlay.add_switch(border, is_border=True)
    overlay.add_switch(robot, borders=[border], uplinks=UPLINKS, links={"direct": False})
    overlay.add_switch(server, borders=[border], links={"direct": False})
    overlay.start(border)
    overlay.start_rib(border)
    overlay.start(robot, server)
    nodes = [
        overlay.add_node(robot, {topic: [Right.PUBLISH] for topic in TOPICS}),
        overlay.add_node(server, {topic: [Right.READ] for topic in TOPICS}),
    ]
    sender, reader = (
        stack.enter_context(overlay.open_session(host, node)) for host, node in zip((robot, server), nodes, strict=True)
    )
    flows: dict[int, Flow] = {}
    for topic, paths in TOPICS.items():
        subscription = reader.subscribe(topic, paths=paths)
        publisher = sender.publisher(topic, paths=paths)
        publisher.wait_for_readers(timeout_s=PATIENCE_S)
        flows[paths] = Flow(publisher, subscription)
    end_s = time.monotonic() + PATIENCE_S
    while not _has_pair(overlay.status(server)):
        if time.monotonic() > end_s:
            raise FailedError("no second path came up")
        time.sleep(0.2)
    return flows


def _has_pair(status: Mapping[str, object]) -> bool:
    """Return whether the reader's switch has two paths for the flow; both use its own uplink."""
    counters = status["counters"]
    assert isinstance(counters, dict)
    return bool(dict(counters["two_paths"])["shared"] == 1)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=30, quick={"rounds": 2}, has_record=True)
    parser.add_argument(
        "--quiet-s", type=float, default=10.0, help="without a cut, for the limit (default: %(default)s)"
    )
    parser.add_argument("--settle-s", type=float, default=SETTLE_S, help="between two cuts (default: %(default)s)")
    run_bench(parser, measure)
