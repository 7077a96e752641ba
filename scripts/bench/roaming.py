"""Roaming bench: silence of a reliable flow through tunnels when a robot's address changes, and its losses.

A robot behind a home NAT publishes 100 bytes a hundred times a second; a server behind another NAT reads. Both know one
border only, and open a direct tunnel. The silence of an event is the longest time between two messages at the reader,
from the event until half a second after the flow came back. It includes the commands of the laboratory that make the
event, whose time is a column of its own: another address is set by netlink at once, another network or public address
takes several programs.

    sudo .venv/bin/python scripts/bench/roaming.py                  # writes docs/benchmarks/roaming.json
    sudo .venv/bin/python scripts/bench/roaming.py --rounds 3 --no-save
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import pairwise
from typing import Final

from peers.process import FailedError
from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, new_run, run_bench

import gdp
from gdp.host.run_registry import RunRegistry
from gdp.trust.right import Right
from internet.access import Access
from internet.host import Host
from internet.laboratory import Laboratory
from internet.overlay import Overlay
from internet.site import Site

TOPIC: Final = "flow"
HZ: Final = 100.0
TARGET_MS: Final = 300.0
SETTLE_S: Final = 3.0
STEADY_S: Final = 0.5
PATIENCE_S: Final = 30.0
COLUMN, P99, LOST, DOUBLED = "silence, ms", "p99, ms", "lost", "doubled"
COMMANDS: Final = "commands, ms"
_NUMBER: Final = struct.Struct("!q92x")


class Flow:
    """A publisher and a reader in this process, each a thread, until ``close``."""

    def __init__(self, publisher: gdp.Publisher, subscription: gdp.Subscription) -> None:
        self._publisher, self._subscription = publisher, subscription
        self._is_over = threading.Event()
        self.arrivals: list[tuple[float, int]] = []  # monotonic second, number
        self.published = 0
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._publish, self._read)]
        for thread in self._threads:
            thread.start()

    def _publish(self) -> None:
        due_s = time.monotonic()
        while not self._is_over.wait(max(due_s - time.monotonic(), 0.0)):
            self._publisher.put(_NUMBER.pack(self.published))
            self.published += 1
            due_s += 1 / HZ

    def _read(self) -> None:
        while not self._is_over.is_set() or len(self.arrivals) < self.published:
            try:
                message = self._subscription.receive(timeout_s=1.0)
            except gdp.SessionError:  # nothing came
                if self._is_over.is_set():
                    return
                continue
            self.arrivals.append((time.monotonic(), _NUMBER.unpack(message.payload)[0]))

    def silence_s(self, since_s: float) -> float:
        """Wait until the flow has been back for ``STEADY_S``; return the longest gap since a moment.

        Raises:
            FailedError: it does not come back.
        """
        end_s = since_s + PATIENCE_S
        while time.monotonic() < end_s:
            time.sleep(0.05)
            times = [at_s for at_s, _ in self.arrivals[-int(PATIENCE_S * HZ) :]]
            before = [at_s for at_s in times if at_s < since_s][-1:]
            marks = [*(before or [since_s]), *(at_s for at_s in times if at_s >= since_s)]
            now_s = time.monotonic()
            late = [mark for mark in marks if mark >= now_s - STEADY_S]
            if now_s - since_s > 2 * STEADY_S and len(late) > 0.8 * STEADY_S * HZ:
                return max(b - a for a, b in pairwise(marks))
        raise FailedError("the flow did not come back")

    def close(self) -> None:
        """Stop publishing, and read what is on its way."""
        self._is_over.set()
        for thread in self._threads:
            thread.join(PATIENCE_S)


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure every event in turn, in one network."""
    over = Rounds()
    with new_run(runs) as run, Laboratory(run) as laboratory, ExitStack() as stack:
        border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
        homes = [laboratory.add_site(f"home{number}", Access.PORT_RESTRICTED) for number in (1, 2)]
        robot = laboratory.add_host("robot", homes[0])
        server = laboratory.add_host("server", laboratory.add_site("office", Access.PORT_RESTRICTED))
        overlay = stack.enter_context(Overlay(laboratory))
        flow = _start(overlay, stack, (border, robot, server), has_direct=not options.no_direct)
        for what, act in _events(robot, homes).items():
            if options.only and not any(words in what for words in options.only):
                continue
            silences = []
            for number in range(options.rounds):
                time.sleep(options.settle_s)
                since_s = time.monotonic()
                act()
                over.add("through tunnels", what, COMMANDS, (time.monotonic() - since_s) * 1e3)
                silences.append(flow.silence_s(since_s) * 1e3)
                over.add("through tunnels", what, COLUMN, silences[-1])
                progress(f"{what}, {number + 1}: {silences[-1]:.0f} ms")
            over.add("through tunnels", what, P99, percentile(silences, 0.99))
        flow.close()
    numbers = [number for _, number in flow.arrivals]
    over.add("through tunnels", "whole run", LOST, flow.published - len(set(numbers)))
    over.add("through tunnels", "whole run", DOUBLED, len(numbers) - len(set(numbers)))
    targets = [
        over.target(f"{what}: p99, ms", "through tunnels", what, P99, TARGET_MS, at_most=True)
        for what in over.cases()[:-1]
    ]
    for column in (LOST, DOUBLED):
        targets.append(over.target(f"messages {column}", "through tunnels", "whole run", column, 0.0, at_most=True))
    settings = {"rounds": options.rounds, "messages": flow.published, "direct": "no" if options.no_direct else "yes"}
    return Outcome("roaming", "Silence when a robot's address changes", over, targets, settings)


def _start(overlay: Overlay, stack: ExitStack, hosts: tuple[Host, Host, Host], *, has_direct: bool) -> Flow:
    border, robot, server = hosts
    overlay.add_switch(border, is_border=True)
    for host in (robot, server):
        overlay.add_switch(host, borders=[border], links={"direct": has_direct})
    overlay.start(border)
    overlay.start_rib(border)
    overlay.start(robot, server)
    nodes = [overlay.add_node(robot, {TOPIC: [Right.PUBLISH]}), overlay.add_node(server, {TOPIC: [Right.READ]})]
    sender, reader = (
        stack.enter_context(overlay.open_session(host, node)) for host, node in zip((robot, server), nodes, strict=True)
    )
    subscription = reader.subscribe(TOPIC)
    publisher = sender.publisher(TOPIC)
    publisher.wait_for_readers(timeout_s=PATIENCE_S)
    end_s = time.monotonic() + PATIENCE_S
    while has_direct and not overlay.tunnels(robot).get("server", {}).get("up"):
        if time.monotonic() > end_s:
            raise FailedError("no direct tunnel came up")
        time.sleep(0.2)
    return Flow(publisher, subscription)


def _events(robot: Host, homes: list[Site]) -> dict[str, Callable[[], object]]:
    """Return what happens in each row."""

    def move() -> None:
        robot.attach(homes[1] if robot.site() is homes[0] else homes[0])

    return {
        "nothing": lambda: None,
        "another address in the same network": robot.renumber,
        "another network": move,
        "another public address": lambda: robot.site().renumber(),
        "the NAT forgets its mappings": lambda: robot.site().flush_mappings(),
    }


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=30, quick={"rounds": 1}, has_record=True)
    parser.add_argument("--no-direct", action="store_true", help="all messages go through the border")
    parser.add_argument("--only", action="append", metavar="WORDS", help="rows whose title has these words")
    parser.add_argument("--settle-s", type=float, default=SETTLE_S, help="between two events (default: %(default)s)")
    run_bench(parser, measure)
