"""Small messages on many topics, reliable, over three kernel switches: 100 bytes, 20 topics, one member at each end.

    4,000/s      a steady rate, topics in turn: loss, latency, what each end costs
    overload     as many as come to be confirmed, at most 2,000 of a topic under way: messages/s

each with bundles (what waits together goes under one seal) and with one seal a message, in turn, round by round. Asked:
nothing lost at the steady rate; in overload at least three times what one seal a message carries.

    sudo .venv/bin/python scripts/bench/bundles.py                     # the whole; writes docs/benchmarks/bundles.*
    sudo .venv/bin/python scripts/bench/bundles.py --quick --no-save   # a few seconds: does it work?
    sudo .venv/bin/python scripts/bench/bundles.py --seconds 60 --rounds 1 --no-save
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Final

from bundles_endpoint import BACKLOG, MESSAGE_BYTES
from bundles_row import READY_S, Row
from machine import machine_state
from peers.process import FailedError
from plot import panel_of, require_plot, save_bars
from report import Goal, Rounds, Settings, progress, show, write_json

from gdp.errors import LocalError
from gdp.nodes.spin import SPIN_US
from gdp.testbed.runs import Runs

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
OUTPUT: Final = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"
QUICK_S: Final = 1.0


def measure(row: Row, settings: dict[str, str | float]) -> dict[str, float]:
    """Return the figures of one try, by column.

    Raises:
        FailedError: an end did not come up, or not everything was confirmed.
    """
    patience_s = 3 * READY_S + float(settings["seconds"])
    with row.end("read", **settings) as reader:
        reader.read(READY_S)
        with row.end("send", **settings) as sender:
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


def run_rounds(row: Row, rounds: int, settings: dict[str, str | float]) -> tuple[Rounds, list[str]]:
    """Return the figures of all rounds, and what went wrong."""
    over, notes = Rounds(), list[str]()
    for at in range(1, rounds + 1):
        for case, rate in ((STEADY, STEADY_RATE), (OVERLOAD, 0)):
            for who in (BUNDLES, SINGLE):
                progress(f"round {at}/{rounds}, {case}: {who}")
                try:
                    found = measure(row, {**settings, "rate": rate, "bundles": who == BUNDLES})
                except FailedError as error:
                    progress(f"FAILED: {error}")
                    notes.append(f"round {at}, {case}, {who}: {error}")
                    found = {}
                for column in (LOST, RATE, MEDIAN, P99, PER_SEAL, *CPU, *CORES):
                    over.add(who, case, column, found.get(column))
    return over, notes


def goals_of(over: Rounds) -> list[Goal]:
    """Return what was asked for."""
    return [
        over.goal(f"{STEADY}: {LOST}", BUNDLES, STEADY, LOST, 0.0, at_most=True),
        over.ratio(f"{OVERLOAD}: {BUNDLES} / {SINGLE}, {RATE}", BUNDLES, SINGLE, OVERLOAD, RATE, RATIO),
        over.goal(f"{OVERLOAD}: {LOST}", BUNDLES, OVERLOAD, LOST, 0.0, at_most=True),
    ]


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each figure (default: %(default)s)")
    parser.add_argument("--topics", type=int, default=20)
    parser.add_argument("--mtu", type=int, default=1_500, help="bytes after the Ethernet header")
    parser.add_argument("--quick", action="store_true", help=f"one round of {QUICK_S:g} s each")
    parser.add_argument("--spin-us", type=int, default=SPIN_US, help="as spin_us of proxy.yaml (default: %(default)s)")
    parser.add_argument("--json", type=Path, default=OUTPUT / "bundles.json", help="where the figures go")
    parser.add_argument("--plot", type=Path, default=OUTPUT / "bundles.png", help="where the picture goes")
    parser.add_argument("--no-plot", action="store_true", help="no picture")
    parser.add_argument("--no-save", action="store_true", help="print only")
    return parser


def main() -> None:
    """Run the bench."""
    options = arguments().parse_args()
    is_drawn = not (options.no_plot or options.no_save)
    if is_drawn:
        require_plot()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was made is removed
    state, begun_s = machine_state(), time.monotonic()
    rounds, seconds = (1, QUICK_S) if options.quick else (options.rounds, options.seconds)
    runs = Runs()
    runs.sweep()
    run = runs.start()
    try:
        with Row(run, options.topics, mtu=options.mtu) as row:
            told = {"topics": options.topics, "seconds": seconds, "spin_s": options.spin_us / 1e6}
            over, notes = run_rounds(row, rounds, dict(told))
    except KeyboardInterrupt:
        sys.exit(130)
    except (LocalError, FailedError) as error:
        sys.exit(f"error: {error}")
    finally:
        run.end()
    settings: Settings = {
        "rounds": rounds,
        "seconds": seconds,
        "topics": options.topics,
        "message, B": MESSAGE_BYTES,
        "under way in overload, of a topic": BACKLOG,
        "MTU": options.mtu,
        "ends spin, us": options.spin_us,
        "trouble": notes or "none",
        "took, s": round(time.monotonic() - begun_s),
    }
    title, goals = "Small messages on many topics, over three kernel switches", goals_of(over)
    show(title, state, settings, over, goals)
    if not options.no_save:
        write_json(options.json, "bundles", state, settings, over, goals)
    if is_drawn:
        panels = [panel_of(over, case, column, [BUNDLES, SINGLE], ours=[BUNDLES])
                  for case, column in ((STEADY, MEDIAN), (OVERLOAD, RATE))]  # fmt: skip
        save_bars(options.plot, title, str(state), panels)


if __name__ == "__main__":
    main()
