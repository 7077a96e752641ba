"""Bench of bundles: reliable small messages over three kernel switches, 100 bytes, 20 topics, one member at each end.

    4,000/s      a steady rate, topics in turn: loss, latency, what each end costs
    overload     as many as come to be confirmed, at most 2,000 of a topic under way: messages/s

Each case runs with bundles (messages that wait together share one seal) and with one seal a message, in turn, round by
round. Targets: no loss at the steady rate; in overload at least three times the rate of one seal a message.

    sudo .venv/bin/python scripts/bench/bundles.py                     # the whole; writes docs/benchmarks/bundles.*
    sudo .venv/bin/python scripts/bench/bundles.py --quick --no-save   # a few seconds: does it work?
    sudo .venv/bin/python scripts/bench/bundles.py --seconds 60 --rounds 1 --no-save
"""

from __future__ import annotations

from typing import Final

from bundles_endpoint import BACKLOG, MESSAGE_BYTES, topics
from peers.process import FailedError
from plot import panel_of
from report import Rounds, Target
from skeleton import Options, Outcome, Recorder, Trial, command_line, new_run, run_bench
from testbed import Lab, MemberRow
from topologies import LEFT, RIGHT, row

from gdp.host.run_registry import RunRegistry
from gdp.nodes.busy_poll import SPIN_US
from gdp.trust.right import Right

BUNDLES: Final = "bundles"
SINGLE: Final = "one seal a message"
STEADY_RATE: Final = 4_000
STEADY: Final = f"{STEADY_RATE:,}/s"
OVERLOAD: Final = "overload"
LOST: Final = "lost"
RATE: Final = "messages/s"
MEDIAN: Final = "p50, ms"
P99: Final = "p99, ms"
PER_SEAL: Final = "messages a seal"
CPU: Final = ("sender, CPU us/message", "reader, CPU us/message")
CORES: Final = ("sender, cores", "reader, cores")
RATIO: Final = 3.0
READY_S: Final = 20.0
COLUMNS: Final = (LOST, RATE, MEDIAN, P99, PER_SEAL, *CPU, *CORES)
QUICK_S: Final = 1.0


def measure_once(members: MemberRow, settings: dict[str, str | float]) -> dict[str, float]:
    """Return the figures of one trial, by column.

    Raises:
        FailedError: an end did not come up, or not everything was confirmed.
    """
    patience_s = 3 * READY_S + float(settings["seconds"])
    with members.endpoint(RIGHT, "read", **settings) as reader:
        reader.read(READY_S)
        with members.endpoint(LEFT, "send", **settings) as sender:
            sent, got = sender.read(patience_s), reader.read(patience_s)
    of_a = {key: value for key, value in sent.items() if isinstance(value, int | float)}
    of_b = {key: value for key, value in got.items() if isinstance(value, int | float)}
    if not of_b.get("got"):
        raise FailedError(f"nothing arrived: A said {sent}, B said {got}")
    cpu_s = (of_a["cpu_s"], of_b["cpu_s"])
    return {
        LOST: of_a["sent"] - of_b["got"],
        RATE: of_b["got"] / of_b["took_s"],
        MEDIAN: 1e3 * of_b["p50_s"],
        P99: 1e3 * of_b["p99_s"],
        PER_SEAL: of_b["got"] / of_b["seals"],
        **{column: 1e6 * each / of_b["got"] for column, each in zip(CPU, cpu_s, strict=True)},
        **{column: each / of_b["took_s"] for column, each in zip(CORES, cpu_s, strict=True)},
    }


def targets_of(over: Rounds) -> list[Target]:
    """Return the targets."""
    return [
        over.target(f"{STEADY}: {LOST}", BUNDLES, STEADY, LOST, 0.0, at_most=True),
        over.ratio(f"{OVERLOAD}: {BUNDLES} / {SINGLE}, {RATE}", BUNDLES, SINGLE, OVERLOAD, RATE, RATIO),
        over.target(f"{OVERLOAD}: {LOST}", BUNDLES, OVERLOAD, LOST, 0.0, at_most=True),
    ]


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure both cases with and without bundles, round by round."""
    settings = {"topics": options.topics, "seconds": options.seconds, "spin_s": options.busy_poll_us / 1e6}
    rights = {LEFT: {Right.PUBLISH: topics(options.topics)}, RIGHT: {Right.READ: topics(options.topics)}}
    recorder = Recorder()
    with (
        new_run(runs) as run,
        MemberRow(Lab(run, row(options.mtu)), "bundles_endpoint", rights, plane="kernel") as members,
    ):
        trials = [
            Trial(case, who, COLUMNS, lambda _, own=own: measure_once(members, {**settings, **own}))  # type: ignore[misc]
            for case, rate in ((STEADY, STEADY_RATE), (OVERLOAD, 0))
            for who in (BUNDLES, SINGLE)
            for own in ({"rate": rate, "bundles": who == BUNDLES},)
        ]
        recorder.interleave(trials, options.rounds)
    over = recorder.rounds
    return Outcome(
        "bundles",
        "Small messages on many topics, over three kernel switches",
        over,
        targets_of(over),
        {
            "rounds": options.rounds,
            "seconds": options.seconds,
            "topics": options.topics,
            "message, B": MESSAGE_BYTES,
            "under way in overload, of a topic": BACKLOG,
            "MTU": options.mtu,
            "ends spin, us": options.busy_poll_us,
            "trouble": recorder.notes or "none",
        },
        lambda: [
            panel_of(over, case, column, [BUNDLES, SINGLE], ours=[BUNDLES])
            for case, column in ((STEADY, MEDIAN), (OVERLOAD, RATE))
        ],
    )


if __name__ == "__main__":
    parser = command_line(
        __doc__, rounds=5, seconds=10.0, quick={"rounds": 1, "seconds": QUICK_S}, has_record=True, has_plot=True
    )
    parser.add_argument("--topics", type=int, default=20)
    parser.add_argument("--mtu", type=int, default=1_500, help="bytes after the Ethernet header")
    parser.add_argument(
        "--busy-poll-us", type=int, default=SPIN_US, help="as busy_poll_us of proxy.yaml (default: %(default)s)"
    )
    run_bench(parser, measure)
