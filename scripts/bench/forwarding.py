"""Forwarding bench: frames a second through one and three switches, round-trip time, and cost of a frame.

    sudo .venv/bin/python scripts/bench/forwarding.py                      minutes; JSON and plot to docs/benchmarks
    sudo .venv/bin/python scripts/bench/forwarding.py --quick --no-save    a few seconds, to see that all works
    sudo .venv/bin/python scripts/bench/forwarding.py --only kernel --only bridge --rounds 5

The baselines are our planes (scapy, raw, kernel with and without redirect_peer), the Linux bridge and the kernel's IPv4
forwarding. In each round they run in the same chain of namespaces, one after the other. Per size of frame and length of
chain:

frames/s            highest rate at which less than 0.1 % is lost and the last frame comes at once (``rate_search.py``)
RTT, polling ends   of single frames, by endpoints that query their socket continuously: the path alone; not measured
                    for planes that are processes where these would share the endpoints' cores
RTT, sleeping ends  by endpoints that wait in epoll, as nodes do
CPU µs/frame        at that rate: the source, soft interrupts (forwarding in the kernel is done by the sender's own, so
                    it shows as the source's time) and switch processes; the sink is left out
forwarding's part, forwarding's share: round trip and CPU, less the cost of directly joined endpoints in the same round

All frames leave through AF_PACKET, IPv4 ones too, so that the source costs the same for all, and no offload takes part.
Everything made is removed, also after an error.
"""

from __future__ import annotations

import os
import statistics
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Final

from baselines import Baseline, Bridge, IPv4, Plane
from chains import Chain
from machine import offload_text
from plot import Panel, panel_of
from rate_search import LOSS_MAX, highest
from report import Rounds, Target, percentile, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.errors import LocalError
from gdp.host.run_registry import RunRegistry
from lab.process import FailedError, LabProcess

PINGS: Final = 1_000
SIZES: Final = {1_500: (128, 1_400), 9_000: (8_900,)}
LENGTHS: Final = (1, 3)
OURS: Final = ("kernel", "kernel, redirect", "raw", "scapy")
OTHERS: Final = ("bridge", "IPv4")
GUESSES: Final = {"raw": 80_000.0, "scapy": 1_500.0}
RATE, LOSS, SINK_LOSS = "frames/s", "loss %", "of it at the sink %"
CPU, SHARE = "CPU µs/frame", "forwarding's share, µs"
POLLED, POLLED_P99, PART = "RTT µs, polling ends: median", "p99, polling", "forwarding's part, µs"
SLEPT, SLEPT_P99 = "RTT µs, sleeping ends: median", "p99, sleeping"


class Bench:
    """Rounds of one run: the figures so far, and the measurement of one baseline in one chain."""

    def __init__(self, seconds: float, pings: int) -> None:
        self.over = Rounds()
        self._seconds = seconds
        self._pings = pings
        self._guesses: dict[tuple[str, str], float] = {}
        self._ends_cpu: dict[int, float] = {}
        self._ends_trip: dict[int, float] = {}

    def measure(self, baseline: Baseline, chain: Chain, sizes: Sequence[int], lengths: Sequence[int]) -> None:
        """Set a baseline up, measure each size, take it down; report the reason if it is not available.

        ``baseline``: what to measure. ``chain``: the chain of namespaces. ``sizes``: of frames, bytes. ``lengths``:
        chains in whose tables the figures appear.
        """
        if baseline.name in self.over.reasons:
            return
        with ExitStack() as undo:
            try:
                workers = undo.enter_context(baseline.stand(chain))
            except (LocalError, FailedError) as error:
                self.over.absent(baseline.name, str(error))
                return
            for size in sizes:
                figures = self._figures(baseline, chain, workers, size)
                for length in lengths:
                    for column, value in figures.items():
                        self.over.add(baseline.name, case_of(size, length), column, value)

    def _figures(
        self, baseline: Baseline, chain: Chain, workers: Sequence[LabProcess], size: int
    ) -> dict[str, float | None]:
        wire = baseline.wire(chain, size)
        pings = min(self._pings, 50) if baseline.name == "scapy" else self._pings
        slept = chain.round_trips(wire, pings, poll=False)
        apart = not baseline.processes or len(os.sched_getaffinity(0)) >= 2 + len(workers)
        polled = chain.round_trips(wire, pings, poll=True) if apart else []
        trip = statistics.median(polled) if polled else None
        if trip is not None and not chain.switches:
            self._ends_trip[size] = trip
        asked = baseline.name, case_of(size, chain.switches)
        guess = self._guesses.get(asked, GUESSES.get(baseline.name)) if baseline.processes else None
        best = highest(lambda rate: chain.attempt(wire, workers, rate, self._seconds), guess)
        cpu = share = None
        if best is not None:
            self._guesses[asked] = best.rate
            cpu = best.cpu_s / best.got * 1e6
            if not chain.switches:
                self._ends_cpu[size] = cpu
            share = cpu - self._ends_cpu[size] if chain.switches and size in self._ends_cpu else None
        return {
            RATE: best.rate if best else None,
            LOSS: best.loss * 100 if best else None,
            SINK_LOSS: best.sink_drops / best.sent * 100 if best else None,
            POLLED: trip,
            POLLED_P99: percentile(polled, 0.99) if polled else None,
            PART: trip - self._ends_trip[size] if trip and chain.switches and size in self._ends_trip else None,
            SLEPT: statistics.median(slept) if slept else None,
            SLEPT_P99: percentile(slept, 0.99) if slept else None,
            CPU: cpu,
            SHARE: share,
        }


def case_of(size: int, switches: int) -> str:
    """Return the heading of a table."""
    return f"{size:,} B, {switches} switch{'es' if switches > 1 else ''}"


def baselines_of(only: Sequence[str]) -> list[Baseline]:
    """Return the selected baselines, by default all; those to compare are adjacent."""
    others = [Bridge("bridge"), IPv4("IPv4")]
    quick: list[Baseline] = [*(Plane(name, processes=False) for name in OURS if name not in GUESSES), *others]
    known = [*quick, *(Plane(name, processes=True) for name in OURS if name in GUESSES)]
    return [each for each in known if not only or each.name in only]


def targets_of(over: Rounds) -> list[Target]:
    """Return the targets of the kernel plane, all in the longer chain."""
    case, plain = case_of(1_400, 3), "kernel, redirect"
    return [
        over.ratio(f"{case}: kernel by plain redirect / bridge, frames/s", plain, "bridge", case, RATE, 1.3),
        over.ratio(f"{case}: kernel / bridge, frames/s", "kernel", "bridge", case, RATE, 1.7),
        over.ratio(
            f"{case}: kernel / IPv4, RTT median by polling ends", "kernel", "IPv4", case, POLLED, 0.7, at_most=True
        ),
        over.ratio(
            f"{case}: kernel / IPv4, RTT median by sleeping ends", "kernel", "IPv4", case, SLEPT, None, at_most=True
        ),
        over.ratio(f"{case}: kernel / IPv4, forwarding's part of the RTT", "kernel", "IPv4", case, PART, None),
        over.ratio(f"{case}: kernel / bridge, forwarding's share of the CPU", "kernel", "bridge", case, SHARE, None),
    ]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure every baseline in every chain, round by round."""
    sizes = {1_500: (1_400,)} if options.quick else SIZES
    bench = Bench(options.seconds, 200 if options.quick else PINGS)
    with ExitStack() as undo:
        chains = {length: undo.enter_context(Chain(runs, length, 1_500)) for length in (0, *LENGTHS)}
        found = offload_text(chains[LENGTHS[-1]].offloads())
        for number in range(1, options.rounds + 1):
            for mtu, bytes_each in sizes.items():
                where = f"round {number} of {options.rounds}, MTU {mtu}"
                for chain in chains.values():
                    chain.set_mtu(mtu)
                progress(f"{where}: ends alone")
                bench.measure(Baseline("ends alone"), chains[0], bytes_each, LENGTHS)
                for length in LENGTHS:
                    for baseline in baselines_of(options.only):
                        progress(f"{where}, {length} in the middle: {baseline.name}")
                        bench.measure(baseline, chains[length], bytes_each, [length])
    settings = {
        "rounds": options.rounds,
        "seconds a try": options.seconds,
        "pings": 200 if options.quick else PINGS,
        "loss below": LOSS_MAX,
        "MTU": list(sizes),
        "cores": "source 0, sink 1, switches anywhere",
        "offloads of the devices (none touches AF_PACKET frames)": found,
    }
    return Outcome(
        "forwarding", "Forwarding", bench.over, targets_of(bench.over), settings, lambda: panels_of(bench.over)
    )


def panels_of(over: Rounds) -> list[Panel]:
    """Return panels of rates by size, round trips and costs, in the longer chain."""
    everyone = (*OURS, *OTHERS, "ends alone")
    panel = partial(panel_of, over, ours=OURS)
    case = case_of(1_400, LENGTHS[-1])
    return [
        *(panel(each, RATE, everyone) for each in over.cases() if each.endswith(f"{LENGTHS[-1]} switches")),
        panel(case, SHARE, everyone, log=True),
        panel(case, POLLED, everyone, p99=POLLED_P99, log=True),
        panel(case, SLEPT, everyone, p99=SLEPT_P99, log=True),
    ]


if __name__ == "__main__":
    parser = command_line(
        __doc__,
        rounds=3,
        seconds=0.3,
        seconds_of="length of one try",
        quick={"rounds": 1, "seconds": 0.15},
        has_record=True,
        has_plot=True,
    )
    parser.add_argument("--only", action="append", choices=[*OURS, *OTHERS], default=[], help="may be repeated")
    run_bench(parser, measure)
