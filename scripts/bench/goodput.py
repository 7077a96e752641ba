"""Goodput bench: a reliable topic of raw images over a link that loses frames, next to Zenoh.

The link is that of ``uplink.py``: a rate, a round trip, random loss and a drop-tail FIFO of one bandwidth-delay product
in each direction. Images of 921,600 bytes are due 30 times a second, which is more than the link carries; a publisher
that waits misses some. Whole images that arrive in the window count.

    sudo .venv/bin/python scripts/bench/goodput.py                  # writes docs/benchmarks/goodput.json
"""

from __future__ import annotations

from functools import partial
from typing import Final

from report import Rounds
from skeleton import Options, Outcome, Recorder, Trial, command_line, run_bench
from thin_link.conditions import Conditions
from thin_link.line import thin_link_lab
from thin_link.systems import SYSTEMS
from thin_link.traffic import CAMERA_BYTES, RELIABLE, streams
from uplink import OURS, exchange

from lab.machines import Lab
from lab.process import new_run

GOODPUT, SHARE, LATE = "goodput, Mbit/s", "link share", "relay late p99, ms"
ROWS: Final = (OURS, "zenoh-tls-block", "zenoh-quic-block")
RATE, RTT_MS, LOSS = "100", 60.0, "1"  # Mbit/s, ms, % of frames
TARGET: Final = 5.0
_IMAGE: Final = streams(RELIABLE)[0]


def goodput(lab: Lab, link: Conditions, name: str, options: Options, _: int) -> dict[str, float]:
    """Return the figures of one system on a link."""
    used, reports = exchange(lab, link, SYSTEMS[name], RELIABLE, options.seconds, with_tcp=False)
    return {
        GOODPUT: reports[_IMAGE.name].whole * 8 * CAMERA_BYTES["raw"] / options.seconds / 1e6,
        SHARE: used.up.share,
        LATE: used.late_ms,
    }


def measure(options: Options) -> Outcome:
    """Measure every system, round by round."""
    recorder = Recorder()
    link = Conditions.of(RATE, RTT_MS, LOSS, "bdp", seed=1)
    for number in range(1, options.rounds + 1):
        with new_run() as run:
            lab = thin_link_lab(run)
            for name in ROWS:
                work = partial(goodput, lab, link, name, options)
                trial = Trial(link.name, name, (GOODPUT, SHARE, LATE), work)
                recorder.attempt(trial, number, options.rounds)
    over: Rounds = recorder.rounds
    settings = {"seconds of each figure": options.seconds, "TCP": "cubic"}
    settings["trouble"] = recorder.notes or "none"
    targets = [
        over.ratio(f"{GOODPUT}: {OURS} / {other}", OURS, other, link.name, GOODPUT, TARGET if at == 0 else 1.0)
        for at, other in enumerate(ROWS[1:])
    ]
    return Outcome("goodput", "Reliable images over a link that loses frames", over, targets, settings)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=3, seconds=15.0, quick={"rounds": 1, "seconds": 3.0}, has_record=True)
    run_bench(parser, measure)
