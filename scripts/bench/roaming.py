"""Roaming bench: silence of a reliable flow through tunnels when a robot's address changes, and its losses.

A robot behind a home NAT publishes 100 bytes a hundred times a second; a server behind another NAT reads. Both know one
border only, and open a direct tunnel. The silence of an event is the longest time between two messages at the reader,
from the event until half a second after the flow came back. It includes the commands of the laboratory that make the
event, whose time is a column of its own: another address is set by one program, another network or public address by
several.

    sudo .venv/bin/python scripts/bench/roaming.py                  # writes docs/benchmarks/roaming.json
    sudo .venv/bin/python scripts/bench/roaming.py --rounds 3 --no-save
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.trust.right import Right
from lab.internet.access import Access
from lab.internet.flow import NumberedFlow, open_sessions
from lab.internet.host import Host
from lab.internet.laboratory import Laboratory
from lab.internet.site import Site
from lab.process import new_run, until

TOPIC: Final = "flow"
TARGET_MS: Final = 300.0
SETTLE_S: Final = 3.0
PATIENCE_S: Final = 30.0
COLUMN, P99, LOST, DOUBLED = "silence, ms", "p99, ms", "lost", "doubled"
COMMANDS: Final = "commands, ms"


def measure(options: Options) -> Outcome:
    """Measure every event in turn, in one network."""
    over = Rounds()
    with new_run() as run, Laboratory(run) as laboratory, ExitStack() as stack:
        homes = [laboratory.add_site(f"home{number}", Access.PORT_RESTRICTED) for number in (1, 2)]
        robot = laboratory.add_host("robot", homes[0])
        flow = _start(robot, stack)
        for what, act in _events(robot, homes).items():
            silences = []
            for number in range(options.rounds):
                time.sleep(SETTLE_S)
                since_s = time.monotonic()
                act()
                over.add("through tunnels", what, COMMANDS, (time.monotonic() - since_s) * 1e3)
                silences.append(flow.silence_until_steady_ms(since_s, PATIENCE_S))
                over.add("through tunnels", what, COLUMN, silences[-1])
                progress(f"{what}, {number + 1}: {silences[-1]:.0f} ms")
            over.add("through tunnels", what, P99, percentile(silences, 0.99))
        flow.close()
    over.add("through tunnels", "whole run", LOST, flow.lost)
    over.add("through tunnels", "whole run", DOUBLED, flow.doubled)
    targets = [
        over.target(f"{what}: p99, ms", "through tunnels", what, P99, TARGET_MS, at_most=True)
        for what in over.cases()[:-1]
    ]
    for column in (LOST, DOUBLED):
        targets.append(over.target(f"messages {column}", "through tunnels", "whole run", column, 0.0, at_most=True))
    settings = {"messages": len(flow.sent_s)}
    return Outcome("roaming", "Silence when a robot's address changes", over, targets, settings)


def _start(robot: Host, stack: ExitStack) -> NumberedFlow:
    overlay, server, (sender, reader) = open_sessions(robot, stack, [{TOPIC: [Right.PUBLISH]}, {TOPIC: [Right.READ]}])
    subscription = reader.subscribe(TOPIC)
    publisher = sender.publisher(TOPIC)
    publisher.wait_for_readers(timeout_s=PATIENCE_S)
    until(lambda: overlay.tunnels(robot).get(server.label, {}).get("up"), lambda: "a direct tunnel", PATIENCE_S)
    return NumberedFlow(publisher, subscription)


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
    run_bench(parser, measure)
