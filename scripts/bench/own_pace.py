"""Own-pace bench: one encoder, and readers behind links of 100, 5 and 1 Mbit/s and behind a lossy one.

A robot publishes JPEG images of 40 kB, best effort, at 30 Hz. Each reader has a switch of its own, and its link from
the middle switch is a relay with a round trip of 20 ms and a FIFO of a second. The fast reader is alone first; then all
four read, who wait for the slowest or have a pace of their own.

    robot - s0 - s1 =+= fast     100 Mbit/s
                     +- medium     5 Mbit/s
                     +- thin       1 Mbit/s
                     +- lossy    100 Mbit/s, 2 % of the frames to it lost in bursts

    sudo .venv/bin/python scripts/bench/own_pace.py                     # writes docs/benchmarks/own_pace.json
    sudo .venv/bin/python scripts/bench/own_pace.py --quick --no-save
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, Final

from report import Rounds, percentile
from skeleton import Options, Outcome, Recorder, Trial, command_line, run_bench
from thin_link.conditions import FRAME_BYTES, Conditions
from thin_link.line import open_line
from thin_link.score import AGE_P50, AGE_P99
from thin_link.systems import run_window, started
from thin_link.traffic import CAMERA_BYTES, OWN_PACE, TOGETHER, streams, wire_bytes

from gdp.host.run_registry import Run
from gdp.trust.right import Right
from lab.machines import BenchNodes, Lab
from lab.namespaces import clear_offloads
from lab.process import new_run
from lab.topology import flat_topology

ROBOT, EDGE, HUB = "robot", "s0", "s1"
LINKS: Final = {"fast": ("100", "0"), "medium": ("5", "0"), "thin": ("1", "0"), "lossy": ("100", "burst")}
RTT_MS: Final = 20.0
SEED: Final = 1  # of the losses
ALONE: Final = "alone"
IMAGES_S, OF_LINK = "images/s", "of the link"
COLUMNS: Final = (IMAGES_S, OF_LINK, AGE_P50, AGE_P99)
_SHARE: Final = 0.9
_OF_ALONE: Final = 0.95
_AGE_MS: Final = 300.0
_SETTLE_S: Final = 6.0


def line_of(reader: str) -> str:
    """Return the machine with the relay of a reader's link."""
    return f"{reader}-link"


def switch_of(reader: str) -> str:
    """Return the switch of a reader."""
    return f"{reader}-sw"


def machines(run: Run) -> Lab:
    """Make all machines; what a relay sees has no offloads. Raises ``LocalError``: the kernel refuses."""
    rows = [(HUB, line_of(each), switch_of(each), each) for each in LINKS]
    links = [(ROBOT, EDGE), (EDGE, HUB), *(pair for row in rows for pair in pairwise(row))]
    lab = Lab(run, flat_topology(links, mtu=FRAME_BYTES, rib=HUB, members=(ROBOT, *LINKS)))
    for each in LINKS:
        line, ends = line_of(each), (HUB, switch_of(each))
        for end in ends:
            lab.inside(end, partial(clear_offloads, line))
            lab.inside(line, partial(clear_offloads, end))
    return lab


def link_of(reader: str) -> Conditions:
    """Return the link of a reader; bursts are counted in frames, so the few frames of reports have no such losses."""
    rate, loss = LINKS[reader]
    link = Conditions.of(rate, RTT_MS, loss, "second", seed=SEED)
    return replace(link, down=replace(link.down, loss=0.0))


def exchange(lab: Lab, readers: Sequence[str], pace: str, options: Options, over: Rounds) -> None:
    """Publish to these readers for a while; add the figures of each."""
    (images,) = streams(pace)
    with ExitStack() as stack:
        lines = [
            stack.enter_context(open_line(lab, link_of(each), line_of(each), (HUB, switch_of(each))))
            for each in readers
        ]
        nodes = stack.enter_context(BenchNodes(lab, (HUB, EDGE, *map(switch_of, readers)), plane="kernel"))
        roles = [*((each, "cloud", Right.READ) for each in readers), (ROBOT, "robot", Right.PUBLISH)]
        own = [
            (each, role, {"config": str(nodes.admit_member(each, {right: [images.name]})), "readers": len(readers)})
            for each, role, right in roles
        ]
        ends = stack.enter_context(started(lab, "gdp", pace, own))
        _, said = run_window(lines, ends, options.seconds, _SETTLE_S)
        for each, reported in zip(readers, said, strict=False):
            figures = figures_of(link_of(each), reported["streams"][images.name], options.seconds)
            for column, figure in figures.items():
                over.add(pace if len(readers) > 1 else ALONE, each, column, figure)


def figures_of(link: Conditions, said: dict[str, Any], span_s: float) -> dict[str, float | None]:
    """Return the figures of a reader, by column."""
    ages, rate = said["ages_s"], said["whole"] / span_s
    p50, p99 = (1e3 * percentile(ages, share) if ages else None for share in (0.5, 0.99))
    of_link = rate * wire_bytes(CAMERA_BYTES["jpeg"]) * 8 / (link.up.bits_s * (1 - link.up.loss))
    return {IMAGES_S: rate, OF_LINK: of_link, AGE_P50: p50, AGE_P99: p99}


def measure(options: Options) -> Outcome:
    """Measure round by round."""
    recorder = Recorder()
    over = recorder.rounds

    def ran(readers: Sequence[str], pace: str, _: int) -> dict[str, float]:
        with new_run() as run:
            exchange(machines(run), readers, pace, options, over)
        return {}

    trials = [
        Trial("fast", ALONE, (), partial(ran, ["fast"], OWN_PACE)),
        *(Trial("all readers", pace, (), partial(ran, [*LINKS], pace)) for pace in (TOGETHER, OWN_PACE)),
    ]
    recorder.interleave(trials, options.rounds)
    ratio = partial(over.ratio, one=OWN_PACE, other=ALONE, case="fast", column=IMAGES_S, asked=_OF_ALONE)
    targets = [ratio("fast, images/s: own-pace / alone")]
    for each in LINKS:
        if each in ("medium", "thin"):
            targets.append(over.target(f"{each}, {OF_LINK}", OWN_PACE, each, OF_LINK, _SHARE))
        asked = _AGE_MS + wire_bytes(CAMERA_BYTES["jpeg"]) * 8e3 / link_of(each).up.bits_s
        targets.append(over.target(f"{each}, {AGE_P99}", OWN_PACE, each, AGE_P99, asked, at_most=True))
    settings = {"seconds of each figure": options.seconds, "seed": SEED}
    return Outcome(
        "own_pace",
        "One encoder, readers behind links of 100, 5 and 1 Mbit/s and a lossy one",
        over,
        targets,
        {**settings, "image, B": CAMERA_BYTES["jpeg"], "trouble": recorder.notes or "none"},
    )


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=3, seconds=15.0, quick={"rounds": 1, "seconds": 5.0}, has_record=True)
    run_bench(parser, measure)
