"""Uplink bench: a robot's traffic over a thin, lossy link with a plain FIFO, compared with others and with TCP.

Robot and cloud are in namespaces; a relay between them has a rate or a recording, a round trip, loss and a drop-tail
FIFO in each direction. On the same link and seed, one after the other:

    gdp                      sessions of the library over two switches; urgent streams have that priority
    zenoh-tls-drop, -block   Zenoh over mutual TLS; congestion control as rmw_zenoh sets it, or blocking
    zenoh-quic-drop, -block  the same over QUIC

Each carries camera (30 Hz, raw or JPEG, best effort), lidar (10 Hz), tf (100 Hz), a map, service calls, and cmd_vel
back (50 Hz): alone, then with one TCP flow (CUBIC) from the robot. Ages are one way, from when a message was due.

    sudo .venv/bin/python scripts/bench/uplink.py                     # a small grid; writes docs/benchmarks/uplink.json
    sudo .venv/bin/python scripts/bench/uplink.py --quick --no-save   # a few seconds each: does it work?
    sudo .venv/bin/python scripts/bench/uplink.py --only gdp --rates 1 5 --rtt 10 --loss 0 burst --fifo bdp --no-save
    sudo .venv/bin/python scripts/bench/uplink.py --rates Verizon-LTE-short --no-save
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final

from machine import DATA, RefusedError
from report import Rounds, Target
from skeleton import Options, Outcome, Recorder, Trial, command_line, run_bench
from thin_link import score
from thin_link.conditions import FIFOS, LOSSES, Conditions
from thin_link.exchange import Tally
from thin_link.line import ADDRESSES, CLOUD, ROBOT, TCP_CONTROL, Used, open_line, thin_link_lab
from thin_link.score import LINK_COLUMNS, STREAM_COLUMNS, link_figures, merged, stream_figures, whole_share
from thin_link.systems import SYSTEMS, System, run_window, start_role
from thin_link.traffic import CAMERA_BYTES, carried_s, streams, wire_bytes

from gdp.errors import LocalError
from lab.machines import Lab
from lab.process import new_run

OURS: Final = "gdp"
TCP: Final = "tcp"
ZENOH: Final = "zenoh-"
GRID: Final = (  # rate, round trip in ms, loss, FIFO
    ("10", 60.0, "0", "second"),
    ("20", 60.0, "1", "bdp"),
    ("100", 60.0, "0", "bdp"),
)
RECORDED: Final = ("Verizon-LTE-short", 60.0, "0", "second")
RTTS_MS: Final = (10.0, 60.0, 200.0)
WARM_UP_S: Final = 3.0
SEED: Final = 1  # of the losses
READY_S: Final = 30.0
RAW_CAMERA_BITS_S: Final = 50e6  # from this rate on, the camera is not compressed
_FIGURES: Final = {"cmd_vel": 15.0, "tf": 15.0}  # asked: age p99 over idle, ms
_AGE_MS: Final = 150.0
_FRESH_SHARE: Final = 0.85
_SATURATED_SHARE: Final = 0.9
_FAIR_SHARE: Final = 0.35


def case_of(link: Conditions, what: str) -> str:
    """Return the name of a case: a link, and a stream or ``link``."""
    return f"{link.name}: {what}"


def camera_of(link: Conditions) -> str:
    """Return the camera on a link, by its rate."""
    return "raw" if link.up.bits_s >= RAW_CAMERA_BITS_S else "jpeg"


def links_of(options: Options) -> list[Conditions]:
    """Return the links of the command line: the small grid, or all combinations of what was chosen.

    Raises ``RefusedError``: an unknown word, or a recording that is not there.
    """
    chosen = (options.rates, options.rtt, options.loss, options.fifo)
    words = [*GRID[:1]] if options.quick else [*GRID, RECORDED]
    if any(chosen):
        words = list(product(*(each or [usual] for each, usual in zip(chosen, GRID[0], strict=True))))
    try:
        return [Conditions.of(*each, seed=SEED, traces=options.traces) for each in words]
    except LocalError as error:
        raise RefusedError(str(error)) from error


def exchange(
    lab: Lab, link: Conditions, system: System | None, camera: str, seconds: float, *, with_tcp: bool
) -> tuple[Used, Mapping[str, Tally]]:
    """Run the traffic of a system once (None: no system), with or without the TCP flow; return use and reports.

    Raises ``FailedError``: a process did not come up, or ended.
    """
    with ExitStack() as stack:
        line = stack.enter_context(open_line(lab, link))
        ends = stack.enter_context(system(lab, camera)) if system else ()
        if with_tcp:
            stack.enter_context(start_role(lab, CLOUD, "tcp-read", {"address": ADDRESSES[CLOUD]})).read(READY_S)
            stack.enter_context(start_role(lab, ROBOT, "tcp-send", {"address": ADDRESSES[CLOUD]})).read(READY_S)
        (used,), said = run_window([line], ends, seconds, WARM_UP_S)
    return used, merged(streams(camera), *(each["streams"] for each in said)) if said else {}


def measure_system(lab: Lab, link: Conditions, name: str, options: Options, over: Rounds, _: int) -> dict[str, float]:
    """Return the figures of a system on a link, and add those of its streams."""
    camera, seconds = camera_of(link), options.seconds
    if name == TCP:
        used = exchange(lab, link, None, camera, seconds, with_tcp=True)[0]
        return {score.TCP_ALONE: used.up.marked_share, score.RELAY_LATE: used.late_ms}
    mix = streams(camera)
    used, reports = exchange(lab, link, SYSTEMS[name], camera, seconds, with_tcp=False)
    could_s = carried_s(mix, 8 * used.up.capacity_bytes / seconds, link.up.loss)
    for each in mix:
        found = stream_figures(each, reports[each.name], link, mix, could_s, seconds)
        for column in STREAM_COLUMNS if each.bulk else STREAM_COLUMNS[:-1]:
            over.add(name, case_of(link, each.name), column, found.get(column))
    both = exchange(lab, link, SYSTEMS[name], camera, seconds, with_tcp=True)[0] if options.tcp else None
    return {**link_figures(link, used, both), score.WHOLE: whole_share(mix, reports, could_s, seconds)}


def trials_of(lab: Lab, link: Conditions, options: Options, over: Rounds) -> list[Trial]:
    """Return the trials of one link: TCP alone, then every system."""
    trials = []
    for name in options.only or [TCP, *SYSTEMS]:
        if options.tcp or name != TCP:
            columns = (score.TCP_ALONE, score.RELAY_LATE) if name == TCP else LINK_COLUMNS
            work = partial(measure_system, lab, link, name, options, over)
            trials.append(Trial(case_of(link, "link"), name, columns, work))
    return trials


def better_zenoh(over: Rounds, case: str, column: str, *, at_most: bool) -> str:
    """Return the Zenoh row with the better median; the first one where none was measured."""
    rows = [name for name in SYSTEMS if name.startswith(ZENOH)]
    spreads = {name: spread for name in rows if (spread := over.spread(name, case, column)) is not None}
    if not spreads:
        return rows[0]
    return (min if at_most else max)(spreads, key=lambda name: spreads[name].median)


def targets_of(over: Rounds, links: Sequence[Conditions]) -> list[Target]:
    """Return the targets of ours on each link, and the ratios to the better Zenoh transport."""
    targets = []
    for link in links:
        for stream, asked in _FIGURES.items():
            case = case_of(link, stream)
            targets.append(over.target(f"{case}, {score.OVER_IDLE}", OURS, case, score.OVER_IDLE, asked, at_most=True))
        case, camera = case_of(link, "camera"), camera_of(link)
        age_ms = _AGE_MS + wire_bytes(CAMERA_BYTES[camera]) * 8e3 / link.up.bits_s
        targets.append(over.target(f"{case}, {score.AGE_P99}", OURS, case, score.AGE_P99, age_ms, at_most=True))
        share = _SATURATED_SHARE if camera == "raw" else _FRESH_SHARE
        targets.append(over.target(f"{case}, {score.OF_LINK}", OURS, case, score.OF_LINK, share))
        for column in (score.SHARE_BOTH, score.TCP_BOTH):
            case = case_of(link, "link")
            targets.append(over.target(f"{case}, {column}", OURS, case, column, _FAIR_SHARE))
        for stream, column, at_most in (
            ("cmd_vel", score.AGE_P99, True),
            ("tf", score.AGE_P99, True),
            ("camera", score.OF_LINK, False),
        ):
            case = case_of(link, stream)
            other = better_zenoh(over, case, column, at_most=at_most)
            what = f"{case}, {column}: gdp / {other}"
            targets.append(over.ratio(what, OURS, other, case, column, 1.0, at_most=at_most))
    return targets


def measure(options: Options) -> Outcome:
    """Measure every system on every link, round by round."""
    recorder, links = Recorder(), links_of(options)
    for number in range(1, options.rounds + 1):
        for link in links:
            with new_run() as run:
                lab = thin_link_lab(run)
                for trial in trials_of(lab, link, options, recorder.rounds):
                    recorder.attempt(trial, number, options.rounds)
    over = recorder.rounds
    return Outcome(
        "uplink",
        "A robot's traffic over a thin link with a plain FIFO",
        over,
        targets_of(over, links) if not options.only or OURS in options.only else [],
        {
            "seconds of each figure": options.seconds,
            "warm-up, s": WARM_UP_S,
            "seed": SEED,
            "TCP of Zenoh": TCP_CONTROL,
            "FIFO up, B": [link.up.fifo_bytes for link in links],
            "camera, B": [CAMERA_BYTES[camera_of(link)] for link in links],
            "trouble": recorder.notes or "none",
        },
        keeps_rows=bool(options.only),
    )


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command_line(__doc__, rounds=1, seconds=6.0, quick={"rounds": 1, "seconds": 2.0}, has_record=True)
    parser.add_argument("--only", nargs="+", choices=[TCP, *SYSTEMS], help="these rows")
    parser.add_argument("--rates", nargs="+", help="Mbit/s, or names of recordings; 1, 5, 20 and 100 are of interest")
    parser.add_argument("--rtt", nargs="+", type=float, help=f"ms, such as {RTTS_MS}")
    parser.add_argument("--loss", nargs="+", choices=list(LOSSES), help="of frames, %%; burst: 2 %% in runs of 8")
    parser.add_argument("--fifo", nargs="+", choices=FIFOS, help="depth of each queue")
    parser.add_argument(
        "--traces", type=Path, default=DATA / "uplinks", help="folder of recordings (default: %(default)s)"
    )
    parser.add_argument("--no-tcp", dest="tcp", action="store_false", help="no TCP flow: half the time")
    return parser


if __name__ == "__main__":
    run_bench(arguments(), measure)
