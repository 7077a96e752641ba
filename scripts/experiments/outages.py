"""Measured availability: machines that stop and come back at random, a service on one of them and on both.

    sudo .venv/bin/python scripts/experiments/outages.py                # 4 minutes; writes docs/experiments/outages.*
    sudo .venv/bin/python scripts/experiments/outages.py --quick        # a few seconds: does it work?

FogROS2-FT considers two spot machines, each up for 15 h and down for 20 min. They are down together less than 0.05 % of
the time, because shares of independent machines multiply. Such times are too long for an experiment. Here the times are
seconds, and the machines are down for a quarter of the time. So both are down together often enough to be measured.
"""

from __future__ import annotations

import random
import time
from collections.abc import Mapping, Sequence
from typing import Final

from asking import Asking
from experiment import Finding, Report, command_line, field_of, run_experiment, work_of
from field import Field, Served
from plot import Span, save_timeline
from samples import Sample, Series
from skeleton import Options

from fog.plan.failure import chance_down, joint

SECONDS: Final = 180.0
QUICK_S: Final = 6.0
UP_S: Final = 9.0
DOWN_S: Final = 3.0
_PAPER_UP_S: Final = 15 * 3_600.0
_PAPER_DOWN_S: Final = 20 * 60.0
_TYPE: Final = "nav_msgs/srv/GetPlan"
_ONE, _TWO = "/serve/m1", "/serve"
_MACHINES: Final = ("m1", "m2")
_HZ: Final = 10.0  # calls a second of each service
_PATIENCE_S: Final = 0.5
_LANES: Final = 1_000
_SEED: Final = 15
_STEP_S: Final = 0.01


class _Stopper:
    """Stops and continues machines on schedule; driven by the samples as they arrive. ``spans``: the outages so far."""

    def __init__(self, place: Field, drawn: Sequence[Span]) -> None:
        self._servers = place.servers
        self._drawn = drawn
        self._down_from_s: dict[str, float] = {}
        self.spans: list[Span] = []

    def see(self, since_s: float, *, is_over: bool = False) -> None:
        """Apply what is due ``since_s`` seconds after the beginning; when it is over, every machine goes on."""
        due = {each.machine for each in self._drawn if each.from_s <= since_s < each.to_s and not is_over}
        for label in due - self._down_from_s.keys():
            self._servers[label].freeze()
            self._down_from_s[label] = since_s
        for label in self._down_from_s.keys() - due:
            self._servers[label].thaw()
            self.spans.append(Span(label, self._down_from_s.pop(label), since_s))


def measure(options: Options) -> Report:
    """Call a service on one machine and one on two, while machines stop and continue."""
    seconds = QUICK_S if options.quick else SECONDS
    drawn = [span for each in _MACHINES for span in draw_outages(random.Random(f"{_SEED} {each}"), seconds, each)]
    served = [Served(_TWO, _TYPE, _MACHINES), Served(_ONE, _TYPE, _MACHINES[:1])]
    work = work_of(served, "replay", {each: {"waits_s": {}} for each in _MACHINES})
    count = round(2 * _HZ * seconds)
    series = Series("plan", (_ONE, _TWO), count, _MACHINES, _PATIENCE_S, lanes=_LANES, gap_s=1 / (2 * _HZ))
    samples: list[Sample] = []
    with field_of(served, work) as here, Asking(here.client, series) as asking:
        stopper = _Stopper(here, drawn)
        begun_s = time.monotonic()
        for sample in asking:
            begun_s = begun_s if samples else sample.begun_s
            samples.append(sample)
            stopper.see(time.monotonic() - begun_s)
        stopper.see(time.monotonic() - begun_s, is_over=True)
        plane = here.data_plane
    groups = {what: [each for each in samples if each.service == name] for what, name in _CASES.items()}
    measured = {label: [each for each in stopper.spans if each.machine == label] for label in _MACHINES}
    return Report.of(
        "outages",
        groups,
        _findings(groups, measured, seconds),
        {"seconds": seconds, "outages": sum(map(len, measured.values())), "switches": plane},
        lambda path, title: save_timeline(path, title, groups["two machines"], stopper.spans, begun_s),
        {"up_s": UP_S, "down_s": DOWN_S, "patience_s": _PATIENCE_S},
    )


_CASES: Final = {"one machine": _ONE, "two machines": _TWO}


def draw_outages(chance: random.Random, seconds: float, machine: str = "") -> list[Span]:
    """Return the outages of a machine within ``seconds``; times up and down are exponential."""
    outages, now_s = [], 0.0
    while (now_s := now_s + chance.expovariate(1 / UP_S)) < seconds:
        outage = Span(machine, now_s, now_s + chance.expovariate(1 / DOWN_S))
        outages.append(outage)
        now_s = outage.to_s
    return outages


def share_unanswered(machines: Sequence[Sequence[Span]], seconds: float, patience_s: float) -> float:
    """Return the share of moments from which all machines stay down for ``patience_s``."""
    moments = [at * _STEP_S for at in range(round(seconds / _STEP_S))]
    lost = sum(
        all(any(each.from_s <= now_s and now_s + patience_s < each.to_s for each in outages) for outages in machines)
        for now_s in moments
    )
    return lost / len(moments)


def _findings(
    groups: Mapping[str, Sequence[Sample]], down: Mapping[str, Sequence[Span]], seconds: float
) -> list[Finding]:
    shares = [100 * sum(not each.is_right for each in samples) / len(samples) for samples in groups.values()]
    lists = [list(down.values())[:1], list(down.values())]
    listed = [100 * share_unanswered(each, seconds, _PATIENCE_S) for each in lists]
    times = [sum(each.to_s - each.from_s for each in outages) / seconds for outages in down.values()]
    paper = chance_down(_PAPER_UP_S, _PAPER_DOWN_S)
    return [
        Finding("one machine: requests unanswered, %", shares[0]),
        Finding("one machine: by the list, %", listed[0]),
        Finding("two machines: requests unanswered, %", shares[1]),
        Finding("two machines: by the list, %", listed[1]),
        Finding("two machines: by arithmetic, of the times down here, %", 100 * joint(times)),
        Finding("one machine: by arithmetic, 15 h up and 20 min down, %", 100 * paper),
        Finding(
            "two machines: by arithmetic, 15 h up and 20 min down, %", 100 * joint([paper, paper]), 0.05, True, "< 0.05"
        ),
    ]


if __name__ == "__main__":
    run_experiment(command_line(__doc__), measure)
