"""Uplink bench: messages that are late when one of a robot's two uplinks is cut, over two paths and over one.

A robot with two uplinks, each behind a NAT of its own, has a tunnel over each to one border. It publishes two topics
of 100 bytes a hundred times a second, one with ``paths: 2`` and one with ``paths: 1``. A server behind another NAT
reads both. A cut lets all packets of one uplink vanish, so that only missing keepalives show it. The uplinks take
turns.

The delay of a message is the time from its publication to its arrival. A message is late if its delay is above the
limit: twice the longest delay of the quiet seconds before the cuts, and at least ``--limit-ms``. That is far below the
210 ms until a switch detects the cut. The silence of a cut is the longest time between two messages.

    sudo .venv/bin/python scripts/bench/uplink_cut.py                  # writes docs/benchmarks/uplink_cut.json
    sudo .venv/bin/python scripts/bench/uplink_cut.py --rounds 2 --no-save
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Final, Literal

from report import Rounds, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.trust.right import Right
from lab.internet.access import Access
from lab.internet.flow import NumberedFlow, open_sessions
from lab.internet.laboratory import Laboratory
from lab.process import new_run, until

UPLINKS: Final = ("wlan0", "wwan0")
TOPICS: Final[dict[str, Literal[1, 2]]] = {"one": 1, "two": 2}  # by the number of paths
TARGET_MS: Final = 300.0
LIMIT_MIN_MS: Final = 100.0
CUT_S: Final = 2.0
SETTLE_S: Final = 6.0  # between two cuts
QUIET_S: Final = 10.0  # without a cut, for the limit
PATIENCE_S: Final = 60.0
LATE, SILENCE, P99, LOST, DOUBLED = "late", "silence, ms", "p99, ms", "lost", "doubled"
_CASES: Final = {1: "paths: 1", 2: "paths: 2"}


def measure(options: Options) -> Outcome:
    """Cut the uplinks in turn, in one network."""
    over = Rounds()
    with new_run() as run, Laboratory(run) as laboratory, ExitStack() as stack:
        flows = start(laboratory, stack)
        sites = [laboratory.sites[each] for each in UPLINKS]
        time.sleep(SETTLE_S)
        quiet_s = time.monotonic()
        time.sleep(QUIET_S)
        limits = {
            paths: max(2 * max(flow.delays_ms(quiet_s, time.monotonic() - 0.5)), options.limit_ms)
            for paths, flow in flows.items()
        }
        silences: dict[int, list[float]] = {paths: [] for paths in flows}
        for number in range(options.rounds):
            site, since_s = sites[number % len(sites)], time.monotonic()
            site.cut()
            time.sleep(CUT_S)
            until_s = time.monotonic()
            site.restore()
            time.sleep(SETTLE_S)
            for paths, flow in flows.items():
                late = sum(delay > limits[paths] for delay in flow.delays_ms(since_s, until_s))
                silences[paths].append(flow.silence_ms(since_s, until_s))
                over.add("tunnels", _CASES[paths], LATE, late)
                over.add("tunnels", _CASES[paths], SILENCE, silences[paths][-1])
                progress(f"cut {number + 1}, {_CASES[paths]}: {late} late, {silences[paths][-1]:.0f} ms")
        for paths, flow in flows.items():
            flow.close()
            over.add("tunnels", _CASES[paths], P99, percentile(silences[paths], 0.99))
            over.add("tunnels", _CASES[paths], LOST, flow.lost)
            over.add("tunnels", _CASES[paths], DOUBLED, flow.doubled)
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
        "messages": sum(len(flow.sent_s) for flow in flows.values()),
        "limit, paths: 2, ms": round(limits[2]),
    }
    return Outcome("uplink_cut", "A cut of one of two uplinks", over, targets, settings)


def start(laboratory: Laboratory, stack: ExitStack) -> dict[int, NumberedFlow]:
    """Start everything; return the two flows by their number of paths, once both have what they asked for.

    Raises ``FailedError``: the second path does not come up.
    """
    homes = [laboratory.add_site(each, Access.PORT_RESTRICTED) for each in UPLINKS]
    robot = laboratory.add_host("robot", homes[0], UPLINKS[0])
    robot.attach(homes[1], UPLINKS[1])
    rights = [{topic: [right] for topic in TOPICS} for right in (Right.PUBLISH, Right.READ)]
    overlay, server, (sender, reader) = open_sessions(robot, stack, rights, has_direct=False, uplinks=UPLINKS)
    flows: dict[int, NumberedFlow] = {}
    for topic, paths in TOPICS.items():
        subscription = reader.subscribe(topic, paths=paths)
        publisher = sender.publisher(topic, paths=paths)
        publisher.wait_for_readers(timeout_s=PATIENCE_S)
        flows[paths] = NumberedFlow(publisher, subscription)
    # The reader's switch then has two paths for the flow; both use its own uplink.
    until(lambda: overlay.status(server)["counters"]["two_paths"]["shared"] == 1, "a second path", PATIENCE_S)
    return flows


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=30, quick={"rounds": 2}, has_record=True)
    parser.add_argument(
        "--limit-ms", type=float, default=LIMIT_MIN_MS, help="least delay of a late message (default: %(default)s)"
    )
    run_bench(parser, measure)
