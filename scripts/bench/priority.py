"""Priority bench: lateness of an urgent message while images fill the path; 100 bytes at 100 Hz over three switches.

One member at A ticks; the floods on the same path are, in turn:

    idle                        nothing
    own images                  the same member's images of 921,600 bytes, reliable, as fast as they are confirmed
    own images, best effort     the same, as fast as they can be sent
    another's images            those of another member at the same switch, reliable

The three switches have the data plane ``kernel``, then ``raw``. Links are as fast as the machine, where both its cores
are busy, or have 100 Mbit/s between the first two switches, where a queue is full. Latency is one way, from the time a
tick was due to its delivery to B's program. Target: p99 of no flood above twice the idle p99 and one frame's time.

    sudo .venv/bin/python scripts/bench/priority.py                     # the whole; writes docs/benchmarks/priority.*
    sudo .venv/bin/python scripts/bench/priority.py --quick --no-save   # a few seconds: does it work?
    sudo .venv/bin/python scripts/bench/priority.py --only raw --link shaped --seconds 20 --no-save
    sudo .venv/bin/python scripts/bench/priority.py --realtime          # all processes under SCHED_FIFO
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Final

from peers.process import FailedError
from plot import Panel, panel_of
from priority_endpoint import CONTROL, TICK_S
from priority_endpoint import IMAGES as IMAGE_TOPIC
from pyroute2 import IPRoute
from report import Rounds, Target, percentile
from skeleton import Options, Outcome, Recorder, Trial, command_line, new_run, run_bench
from testbed import Lab, MemberRow
from topologies import MIDDLE, flat_topology

from gdp.host.run_registry import Run, RunRegistry
from gdp.runtime.busy_poll import SPIN_US
from gdp.trust.right import Right

MTU: Final = 1_500
SHAPED_BITS_S: Final = 100_000_000
_BURST_BYTES: Final = 2 * (MTU + 14)  # tbf must be able to send one frame; more would let a flood run ahead
_LINKS: Final = (("a", "s1"), ("c", "s1"), ("b", "s3"), ("s1", "s2"), ("s2", "s3"))
# Under SCHED_FIFO: a flood never sleeps, so equals would starve.
_PRIORITIES: Final = {"switch": 3, "rib": 3, "tick": 2, "read": 2, "flood": 1}
PLANES: Final = ("kernel", "raw")
LINKS: Final = {"free": "free links", "shaped": f"{SHAPED_BITS_S // 1_000_000} Mbit/s"}
IDLE: Final = "idle"
FLOODS: Final = {  # whose images, and how
    IDLE: ("none", ""),
    "own images": ("a", "reliable"),
    "own images, best effort": ("a", "best-effort"),
    "another's images": ("c", "reliable"),
}
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
WORST: Final = "worst, ms"
IMAGES: Final = "images/s"
OF_BOUND: Final = "p99 / (2 x idle p99 + frame)"
QUICK_S: Final = 1.0
READY_S: Final = 20.0
FRAME_MS: Final = {"free": 0.0, "shaped": (MTU + 14) * 8e3 / SHAPED_BITS_S}


def case_of(plane: str, link: str) -> str:
    """Return the name of a case."""
    return f"{plane}, {LINKS[link]}"


def measure_flood(members: MemberRow, flood: str, seconds: float, spin_s: float) -> dict[str, float]:
    """Return the figures of one flood, by column.

    Raises:
        FailedError: a process did not come up, or a tick did not arrive.
    """
    where, kind = FLOODS[flood]
    with ExitStack() as stack:
        reader = stack.enter_context(members.endpoint("b", "read", spin_s=spin_s))
        reader.read(READY_S)
        if where == "c":
            stack.enter_context(members.endpoint("c", "flood", flood=kind, spin_s=spin_s)).read(READY_S)
        own = kind if where == "a" else ""
        ticker = stack.enter_context(members.endpoint("a", "tick", flood=own, seconds=seconds, spin_s=spin_s))
        ticker.read(2 * READY_S + seconds)
        said = reader.read(READY_S)
    latencies_s, images_s = said.get("latencies_s"), said.get("images_s")
    if not isinstance(latencies_s, list) or not isinstance(images_s, float):
        raise FailedError(f"B said {said}")
    latencies_ms = [1e3 * each for each in latencies_s]
    if len(latencies_ms) < round(seconds / TICK_S):
        raise FailedError(f"of {round(seconds / TICK_S)} ticks {len(latencies_ms)} arrived")
    return {
        MEDIAN: percentile(latencies_ms, 0.5),
        P99: percentile(latencies_ms, 0.99),
        WORST: max(latencies_ms),
        IMAGES: images_s,
    }


def measure_row(run: Run, plane: str, link: str, recorder: Recorder, number: int, options: Options) -> None:
    """Measure every flood on one plane and link; the idle one sets the round's bound."""
    case, columns = case_of(plane, link), (MEDIAN, P99, WORST, IMAGES)
    topology = flat_topology(_LINKS, mtu=MTU, rib="s2", members=("a", "c", "b"), switches=("a", "c", *MIDDLE, "b"))
    lab = Lab(run, topology, priorities=_PRIORITIES if options.realtime else None)
    if link == "shaped":
        lab.inside("s1", partial(_shape, "s2"))
    topics = (CONTROL, IMAGE_TOPIC)
    rights = {node: {Right.READ if node == "b" else Right.PUBLISH: topics} for node in ("a", "c", "b")}
    bound_ms: float | None = None
    with MemberRow(lab, "priority_endpoint", rights, plane=plane) as members:
        for flood in FLOODS:
            work = partial(measure_flood, members, flood, options.seconds, options.busy_poll_us / 1e6)
            trial = Trial(case, flood, columns, lambda _, work=work: work())  # type: ignore[misc]
            found = recorder.attempt(trial, number, options.rounds)
            if flood == IDLE and found:
                bound_ms = 2 * found[P99] + FRAME_MS[link]
            recorder.rounds.add(flood, case, OF_BOUND, found[P99] / bound_ms if bound_ms and found else None)


def _shape(device: str) -> None:
    """Limit a device to ``SHAPED_BITS_S``: a token bucket around ``pfifo_fast``, three bands that every kernel has."""
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.tc("add", "tbf", index, 0x10000, rate=SHAPED_BITS_S // 8, burst=_BURST_BYTES, limit=1 << 20)
        here.tc("add", "pfifo_fast", index, 0x20000, parent=0x10001)


def targets_of(over: Rounds, cases: Sequence[str]) -> list[Target]:
    """Return the targets: no flood exceeds the bound, which the idle case sets in each round."""
    floods = [flood for flood in FLOODS if flood != IDLE]
    targets = [over.target(f"{case}: {flood}, {OF_BOUND}", flood, case, OF_BOUND, 1.0, at_most=True)
             for case in cases for flood in floods]  # fmt: skip
    ratios = [over.ratio(f"{case}: {flood} / {IDLE}, p99", flood, IDLE, case, P99, None)
              for case in cases for flood in floods]  # fmt: skip
    return targets + ratios


def panels_of(over: Rounds, cases: Sequence[str]) -> list[Panel]:
    """Return a panel for each case: medians, whiskers to the p99."""
    return [panel_of(over, case, MEDIAN, list(FLOODS), p99=P99, ours=list(FLOODS)) for case in cases]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure every plane on every link, round by round."""
    recorder, rows = Recorder(), [(each, on) for each in options.only or PLANES for on in options.link or LINKS]
    for number in range(1, options.rounds + 1):
        for plane, link in rows:
            with new_run(runs) as run:
                measure_row(run, plane, link, recorder, number, options)
    over, cases = recorder.rounds, [case_of(plane, link) for plane, link in rows]
    return Outcome(
        "priority",
        "A tick of 100 bytes at 100 Hz with images, over three switches",
        over,
        targets_of(over, cases),
        {
            "rounds": options.rounds,
            "ticks for each figure": round(options.seconds / TICK_S),
            "MTU": MTU,
            "one frame's time at 100 Mbit/s, ms": round(FRAME_MS["shaped"], 3),
            "scheduler": "SCHED_FIFO" if options.realtime else "ordinary",
            "ends spin, us": options.busy_poll_us,
            "trouble": recorder.notes or "none",
        },
        lambda: panels_of(over, cases),
    )


if __name__ == "__main__":
    parser = command_line(
        __doc__,
        rounds=5,
        seconds=8.0,
        seconds_of="of ticks for each figure",
        quick={"rounds": 1, "seconds": QUICK_S},
        has_record=True,
        has_plot=True,
    )
    parser.add_argument("--only", action="append", choices=PLANES, help="this data plane")
    parser.add_argument("--link", action="append", choices=list(LINKS), help="on such links")
    parser.add_argument(
        "--busy-poll-us", type=int, default=SPIN_US, help="as busy_poll_us of proxy.yaml (default: %(default)s)"
    )
    parser.add_argument("--realtime", action="store_true", help="SCHED_FIFO: what else runs does not disturb")
    run_bench(parser, measure)
