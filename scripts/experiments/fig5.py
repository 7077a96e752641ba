"""Figure 5: motion planning on Home, Cubicles and Twistycool, one server against two.

    sudo .venv/bin/python scripts/experiments/fig5.py                  # writes docs/experiments/fig5.*
    sudo .venv/bin/python scripts/experiments/fig5.py --quick          # a few seconds: does it work?
    sudo .venv/bin/python scripts/experiments/fig5.py --no-planning    # only the servers that wait: 4 minutes

Two planners that share a machine's cores do not show the effect of two machines. So there are also servers that wait
as long as a recorded run took, and compute nothing. The time of each request is then known before, and the result can
be compared with arithmetic. With these servers the number of trials is the paper's.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Collection, Mapping, Sequence
from statistics import fmean
from typing import Final

from asking import Asking
from experiment import CASES, Finding, Report, command_line, field_of, gains, latencies_of, run_experiment, work_of
from field import Field, Served, Work
from machine import DATA, RefusedError, data_folder
from plot import save_distributions
from recorded import FASTER, LIMIT_S, draw, load
from samples import Sample, Series, least_of_two, p99
from skeleton import Options

TYPE: Final = "nav_msgs/srv/GetPlan"
TRIALS: Final = {"Home": 12, "Cubicles": 60, "Twistycool": 5}
TIMEOUT_S: Final = 45.0
QUICK: Final = ("Slit", 3, 5)  # problem, trials, waits
_MESHES: Final = DATA / "planning"
_PLANNER: Final = "RRTConnect"
_ONE, _TWO = "/plan/m1", "/plan"
_MACHINES: Final = ("m1", "m2")
_WAITS: Final = 100
_LOG_NORMAL: Final = "log-normal"
_WAIT_MEAN_S: Final = 0.15
_SIGMA: Final = 1.0
_SEED: Final = 5
_SLACK_S: Final = 20.0
_STOP: Final = {"stop": f"{_TWO}/stop", "at_once": 1}  # the planner works on one at a time
_PAPER: Final = {  # mean gain, p99 gain
    "Home": ("", "between 1.42 and 5.53"),
    "Cubicles": ("1.22; 1.16 in the introduction", "5.53"),
    "Twistycool": ("at most 1.22", "1.42"),
}


def measure(options: Options) -> Report:
    """Plan motions with one server and with two replicas."""
    counts, waits, timeout = dict(TRIALS), options.waits, TIMEOUT_S
    if options.quick:
        counts, waits = {QUICK[0]: QUICK[1]}, min(waits, QUICK[2])
    counts = counts if options.planning else {}
    if counts:
        _check(counts)
    groups: dict[str, list[Sample]] = {}
    findings: list[Finding] = []
    plan = {
        "folder": str(_MESHES), "problems": " ".join(counts), "planner": _PLANNER, "patience_s": timeout
    }  # fmt: skip
    if counts:
        with field_of(*_fleet("plan", dict.fromkeys(_MACHINES, plan), _STOP, timeout + _SLACK_S)) as here:
            for name, count in counts.items():
                found = _ask(here, name, count, patience_s=timeout + _SLACK_S)
                groups |= _named(f"{name}, computed", found)
                findings += _planning_findings(name, found)
    lists = _lists(waits, ["Cubicles"] if options.quick else FASTER) if waits else {}
    if lists:
        own = {each: {"waits_s": {name: both[at] for name, both in lists.items()}} for at, each in enumerate(_MACHINES)}
        with field_of(*_fleet("replay", own, {}, _SLACK_S)) as here:
            for name, both in lists.items():
                found = _ask(here, name, waits, patience_s=_SLACK_S)
                groups |= _named(name, found)
                findings += _waiting_findings(name, found, both)
    panels = latencies_of(groups, "{name}, {case}", [*(f"{each}, computed" for each in counts), *lists], 1.0)
    return Report.of(
        "fig5",
        groups,
        findings,
        {
            "computed trials": ", ".join(f"{n} {count}" for n, count in counts.items()) or "none",
            "timeout, s": timeout,
            "planner": _PLANNER,
            "trials of each wait": waits,
        },
        lambda path, title: save_distributions(path, title, panels, "latency, s"),
        _figures(counts, timeout),
    )


def _named(what: str, found: Mapping[str, list[Sample]]) -> dict[str, list[Sample]]:
    return {f"{what}, {case}": found[name] for case, name in zip(CASES, (_ONE, _TWO), strict=True)}


def _check(problems: Collection[str]) -> None:
    """Refuse to plan without the libraries or the problems. Raises ``RefusedError``: one is missing."""
    try:
        from planning import PROBLEMS
    except ImportError as error:
        missing = f"{error.name} is not installed: pip install 'gdp-ros[experiments]', or go without: --no-planning"
        raise RefusedError(missing) from error
    for each in problems:
        data_folder("planning", [f"{PROBLEMS[each]}{kind}" for kind in (".cfg", "_env.dae", "_robot.dae")])


def _fleet(
    role: str, own: Mapping[str, Mapping[str, object]], options: Mapping[str, object], timeout_s: float
) -> tuple[list[Served], dict[str, Work]]:
    """Return the services and the machines' work."""
    imports = {"timeout_s": timeout_s}
    served = [Served(_TWO, TYPE, _MACHINES, options, imports), Served(_ONE, TYPE, _MACHINES[:1], {}, imports)]
    return served, work_of(served, role, own)


def _ask(here: Field, problem: str, count: int, *, patience_s: float) -> dict[str, list[Sample]]:
    series = Series("plan", (_ONE, _TWO), 2 * count, _MACHINES, patience_s, problem=problem)
    with Asking(here.client, series) as asking:
        return asking.by_service(problem)


def _planning_findings(name: str, found: Mapping[str, Sequence[Sample]]) -> list[Finding]:
    alone = [each.latency_s for each in found[_ONE]]
    offline = p99(alone) / p99(least_of_two(alone) or alone)
    return [
        *gains(f"{name}, computed: {{}} gain", found[_ONE], found[_TWO], _PAPER.get(name, ("", ""))),
        Finding(f"{name}, computed: p99 gain offline, least of any two of one server's samples", offline),
    ]


def _waiting_findings(
    name: str, found: Mapping[str, Sequence[Sample]], both: Sequence[Sequence[float]]
) -> list[Finding]:
    paper = _PAPER.get(name.partition(",")[0], ("", ""))
    mean_gain, p99_gain = gains(f"{name}: {{}} gain", found[_ONE], found[_TWO], paper)
    least = [min(each) for each in zip(*both, strict=True)]
    offline = p99(both[0]) / p99(least)
    added_ms = 1e3 * (fmean(each.latency_s for each in found[_ONE]) - fmean(both[0]))
    return [
        mean_gain,
        Finding(f"{name}: mean gain offline", fmean(both[0]) / fmean(least)),
        p99_gain,
        Finding(f"{name}: p99 gain offline", offline),
        Finding(f"{name}: p99 gain / p99 gain offline", p99_gain.measured / offline, 0.95),
        Finding(f"{name}: latency less wait, one server, mean, ms", added_ms),
    ]


def _lists(count: int, problems: Collection[str]) -> dict[str, tuple[list[float], list[float]]]:
    """Return for each kind of wait the seconds of either machine."""
    chance, recorded = random.Random(_SEED), load()
    lists = {}
    for name in problems:
        faster, runs_s = FASTER[name], recorded[name].runs_s
        what = f"{name}, waits" + (f" / {faster:g}" if faster != 1 else "")
        lists[what] = (draw(runs_s, faster, count, chance), draw(runs_s, faster, count, chance))

    def log_normal() -> list[float]:
        return [_WAIT_MEAN_S * chance.lognormvariate(-(_SIGMA**2) / 2, _SIGMA) for _ in range(count)]

    return lists | {f"{_LOG_NORMAL}, waits": (log_normal(), log_normal())}


def _figures(counts: Mapping[str, int], timeout_s: float) -> dict[str, object]:
    counted = ", ".join(f"{count} of {name}" for name, count in counts.items())
    runs, gained = [], []
    for name, each in load().items():
        stopped = sum(run_s >= LIMIT_S for run_s in each.runs_s)
        runs.append(f"{len(each.runs_s)} of {each.planner} in {name}, of which {stopped} reached the timeout")
        gained.append("{}: mean {:.2f}, p99 {:.2f}".format(name, *each.gains()))
    figures = {"runs": "; ".join(runs), "gains": "; ".join(gained), "counted": counted or "none in this run"}
    return {**figures, "limit_s": LIMIT_S, "timeout_s": timeout_s}


if __name__ == "__main__":
    parser = command_line(__doc__)
    parser.add_argument("--waits", type=int, default=_WAITS, help="trials of each wait; 0: none (default: %(default)s)")
    parser.add_argument("--planning", action=argparse.BooleanOptionalAction, default=True, help="plan, or only wait")
    run_experiment(parser, measure)
