"""Anycast: a robot roams among three replicas behind 5, 20 and 80 ms, which are killed; the nearest one answers.

Then it reads a capsule, of which three holders stand there; the nearest one dies in mid-transfer.

.venv/bin/python scripts/experiments/anycast.py                  # writes docs/experiments/anycast.*
.venv/bin/python scripts/experiments/anycast.py --quick          # a few seconds: does it work?

The network is simulated, with the cores of real nodes and a virtual clock.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from experiment import Finding, Report, command_line, run_experiment
from plot import Span, save_timeline
from samples import Sample, p99
from skeleton import Options

from lab.holder_sites import HolderSites
from lab.sites import Sites

TURNS: Final = 40
QUICK: Final = 2
APART_S: Final = (0.015, 0.06)
NEAR_S: Final = 0.005
SIZE: Final = 1_000
_HZ: Final = 20.0
_MOVED_S: Final = 1.0
_PHASE_S: Final = 3.0  # after a move, after a death and after a restart
_RECORD_BYTES: Final = 60_000
_READ_S: Final = 30.0
_SHOWN: Final = 8  # turns, in the picture
_SEED: Final = 37


@dataclass(slots=True)
class _Roaming:
    """Turns of one robot: it moves, the nearest replica is killed, and starts again.

    Attributes:
        moved: seconds of the moves.
        spans: in which a replica was away.
        next_s: seconds from each death to the next answer, without the round trip to the next replica.
        away: requests that the nearest replica did not answer, begun a second after a move or later.
        settled: how many were begun then.
        reached_s: seconds from each move to the first request that the nearest replica answered.
    """

    sites: Sites
    moved: list[float] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)
    next_s: list[float] = field(default_factory=list)
    reached_s: list[float] = field(default_factory=list)
    away: int = 0
    settled: int = 0

    def turn(self, place: int) -> None:
        """Move to a place; there the nearest replica dies and returns."""
        sites = self.sites
        sites.call_often(3 * _PHASE_S, 1 / _HZ)
        sites.roam(place)
        moved_s = sites.now_s
        self.moved.append(moved_s)
        sites.run(_PHASE_S)
        since = [each for each in sites.requests if each.begun_s >= moved_s]
        settled = [each for each in since if moved_s + _MOVED_S <= each.begun_s < sites.now_s - 0.1]
        self.settled += len(settled)
        self.away += sum(each.by != sites.label(place) for each in settled)
        reached = [each.begun_s - moved_s for each in since if each.by == sites.label(place)]
        self.reached_s.append(min(reached, default=_PHASE_S))
        sites.kill(place)
        died_s = sites.now_s
        (following,) = sites.nearest()
        sites.run(_PHASE_S)
        answers = [each.answered_s for each in sites.requests if each.by == sites.label(following)]
        first_s = min(each for each in answers if each > died_s)
        self.next_s.append(first_s - died_s - sites.trip_s(following))
        sites.restart(place)
        sites.run(_PHASE_S)
        self.spans.append(Span(f"site {place}", died_s, died_s + _PHASE_S))


@dataclass(slots=True)
class _Readings:
    """Readings of a capsule at the nearest holder, which dies in mid-transfer.

    Attributes:
        next_s: seconds from each death to the request that the next holder gets, without the path to it.
        away: requests for records that another holder than the nearest one alive got.
        asked: how many there were.
        wrong: records that were lost, doubled or out of order.
    """

    sites: HolderSites
    next_s: list[float] = field(default_factory=list)
    away: int = 0
    asked: int = 0
    wrong: int = 0

    def turn(self, place: int, after: int) -> None:
        """Move to a place, and read; after some records the holder dies, and returns for the next turn."""
        sites = self.sites
        sites.roam(place)
        sites.run(_PHASE_S)
        reading, begun_s, (first,) = sites.begin_reading(), sites.now_s, sites.nearest()
        sites.read(reading, _READ_S, lambda: len(reading.kept) >= after)
        sites.kill(first)
        died_s, (following,) = sites.now_s, sites.nearest()
        sites.read(reading, _READ_S)
        got = [each.message for each in reading.kept]
        self.wrong += abs(len(got) - len(sites.sent)) + sum(
            one != two for one, two in zip(got, sites.sent, strict=False)
        )
        reads = [(at_s, site) for at_s, site in sites.reads_since(begun_s) if at_s <= died_s or site != first]
        later = [at_s for at_s, site in reads if at_s > died_s]
        self.next_s.append(later[0] - died_s - sites.trip_s(following) / 2)
        reads.pop()  # the last holder is asked, too, whether it has more
        self.asked += len(reads)
        self.away += sum(site != (first if at_s <= died_s else following) for at_s, site in reads)
        sites.restart(first)


def _read_capsules(turns: int, chance: random.Random) -> _Readings:
    """Let a robot read a capsule in each turn."""
    with tempfile.TemporaryDirectory() as folder:
        readings = _Readings(HolderSites(apart_s=APART_S, near_s=NEAR_S, size=_RECORD_BYTES, folder=Path(folder)))
        sites = range(len(APART_S) + 1)
        for _ in range(turns):
            place = chance.choice([each for each in sites if each != readings.sites.at])
            readings.turn(place, chance.randint(1, 35))
        readings.sites.close()
    return readings


def measure(options: Options) -> Report:
    """Let a robot roam among replicas that die."""
    turns, chance = QUICK if options.quick else TURNS, random.Random(_SEED)
    sites = Sites(apart_s=APART_S, near_s=NEAR_S, size=SIZE)
    roaming, begun_s, before, place = _Roaming(sites), sites.now_s, sites.uplink_frames, 0
    for _ in range(turns):
        place = chance.choice([each for each in range(len(APART_S) + 1) if each != place])
        roaming.turn(place)
    sites.run(_PHASE_S)
    copies, frames = sum(map(len, sites.executed.values())) / len(sites.executed), sites.uplink_frames - before
    readings = _read_capsules(turns, chance)
    shown = [each for each in _samples(sites, begun_s) if each.begun_s < 3 * _PHASE_S * _SHOWN]
    spans = [Span(each.machine, each.from_s - begun_s, each.to_s - begun_s) for each in roaming.spans[:_SHOWN]]
    moves = [each - begun_s for each in roaming.moved[:_SHOWN]]
    return Report.of(
        "anycast",
        {"all requests": _samples(sites, begun_s)},
        [
            Finding(
                "at the nearest replica, a second after a move, %", 100 * (1 - roaming.away / roaming.settled), 100
            ),
            Finding("from a move to the first request there, worst, s", max(roaming.reached_s), _MOVED_S, True),
            Finding("next answer after a death, less the round trip, p99, ms", 1e3 * p99(roaming.next_s), 300, True),
            Finding("capsule read at the nearest holder, %", 100 * (1 - readings.away / readings.asked), 100),
            Finding("next holder asked after a death, less the path, worst, ms", 1e3 * max(readings.next_s), 300, True),
            Finding("records lost or doubled in these readings", readings.wrong, 0, True),
            Finding("executions of a request, mean", copies),
            Finding("frames on the uplink for a request of one frame", frames / len(sites.requests), 1.1, True),
        ],
        {"turns": turns, "requests": len(sites.requests), "clock": "virtual"},
        lambda path, title: save_timeline(path, title, shown, spans, 0.0, moves),
        {"hz": _HZ, "size": SIZE, "turns": turns},
    )


def _samples(sites: Sites, begun_s: float) -> Sequence[Sample]:
    return [
        Sample(
            "/plan", each.begun_s - begun_s, each.answered_s - each.begun_s, f"site {each.by[1:2]}", 0.0, bool(each.by)
        )
        for each in sites.requests
    ]


if __name__ == "__main__":
    run_experiment(command_line(__doc__), measure, is_timed=False)
