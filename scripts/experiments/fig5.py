"""Figure 5: motion planning on Home, Cubicles and Twistycool, one server against two; and waits that compute nothing.

    sudo .venv/bin/python scripts/experiments/fig5.py                  # writes docs/experiments/fig5.*
    sudo .venv/bin/python scripts/experiments/fig5.py --quick          # a few seconds: does it work?
    sudo .venv/bin/python scripts/experiments/fig5.py --trials 100 --timeout 100    # as the paper: hours
    sudo .venv/bin/python scripts/experiments/fig5.py --problem Cubicles --planner RRT --out /tmp/fig5

Two planners that share a machine's cores do not show what two machines would. So beside the planners stands a service
that waits as long as a planner once took, and computes nothing: how long each request takes is known beforehand, and
what the overlay makes of it can be held against arithmetic.
"""

from __future__ import annotations

import json
import random
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Annotated, Final

import typer
from bench_path import ROOT
from field import Field, Served, Work
from machine import machine_state
from pictures import save_distributions
from samples import Sample, Summary, least_of_two, p99
from series import Series
from study import (
    Asking,
    Finding,
    JsonOption,
    OutOption,
    QuickOption,
    Report,
    conclude,
    field_of,
    place_of,
)

__all__: list[str] = []

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

TYPE: Final = "nav_msgs/srv/GetPlan"
MESHES: Final = ROOT.parent / "shared" / "data" / "planning"
RECORDED: Final = Path(__file__).with_name("cubicles_s.json")
TRIALS: Final = {"Home": 12, "Cubicles": 60, "Twistycool": 5}
TIMEOUT_S: Final = 45.0
QUICK: Final = ("Cubicles", 3, 10)  # problem, trials, waits
_ONE, _TWO = "/plan/m1", "/plan"
_MACHINES: Final = ("m1", "m2")
_WAITS: Final = 300
_WAIT_MEAN_S: Final = 0.15
_SIGMA: Final = 1.0
_LANES: Final = 4
_SEED: Final = 5
_SLACK_S: Final = 20.0
_STOP: Final = {"stop": f"{_TWO}/stop", "at_once": 1}  # the planner works on one at a time
_SETTING: Final = (
    "A robot asks for a way of a rigid body among obstacles: OMPL's planner in OMPL.app's problems, collisions by"
    " FCL, in a ROS 2 node whose service is nav_msgs/srv/GetPlan. *One server* is always the same one; *two"
    " replicas* both get the request, and the first answer wins. The cases take turns, trial by trial.",
    "*Waits* are a service that waits as long as a list says: planning times recorded from Cubicles (processor"
    " seconds of 200 runs, drawn with replacement), or a log-normal distribution with sigma 1, scaled to a mean of"
    " 0.15 s. Each replica has a list of its own, and request number i waits entry i of either list, so that the"
    " least of the two is known beforehand: *offline* figures are computed from the lists alone, without any"
    " overlay.",
)


@app.command(epilog="Example: sudo .venv/bin/python scripts/experiments/fig5.py --problem Cubicles --trials 20")
def main(
    problem: Annotated[list[str] | None, typer.Option(help="One of them; may be repeated. Default: all three.")] = None,
    trials: Annotated[int, typer.Option(help="Of each problem and case; 0: a number that a person waits for.")] = 0,
    timeout: Annotated[float, typer.Option(help="Seconds after which a planner gives up.")] = TIMEOUT_S,
    planner: Annotated[str, typer.Option(help="Its class in ompl.geometric.")] = "RRTConnect",
    waits: Annotated[int, typer.Option(help="Requests of each wait and case; 0: none.")] = _WAITS,
    meshes: Annotated[Path, typer.Option(help="Folder of the problems.")] = MESHES,
    planning: Annotated[bool, typer.Option(help="Plan; without it there are only the waits.")] = True,
    stop: Annotated[bool, typer.Option(help="Tell the replica that was slower to stop.")] = True,
    quick: QuickOption = False,
    as_json: JsonOption = False,
    out: OutOption = None,
) -> None:
    """Plan motions with one server and with two replicas."""
    state, place = machine_state(), place_of(out, quick=quick)
    counts = {each: trials or TRIALS.get(each, 20) for each in problem or TRIALS}
    if quick:
        counts, waits = {QUICK[0]: QUICK[1]}, min(waits, QUICK[2])
    counts = counts if planning else {}
    if counts:
        _check(counts, planner, meshes)
    groups: dict[str, list[Sample]] = {}
    findings: list[Finding] = []
    told = {"folder": str(meshes), "problems": " ".join(counts), "planner": planner, "patience_s": timeout}
    options = _STOP if stop else {}
    if counts:
        with field_of(*_fleet("plan", dict.fromkeys(_MACHINES, told), options, timeout + _SLACK_S)) as here:
            for name, count in counts.items():
                found = _ask(here, name, count, lanes=1, patience_s=timeout + _SLACK_S)
                groups[f"{name}, one server"], groups[f"{name}, two replicas"] = found[_ONE], found[_TWO]
                findings += _planning_findings(name, found)
    lists = _lists(waits) if waits else {}
    if lists:
        own = {each: {"waits_s": {name: both[at] for name, both in lists.items()}} for at, each in enumerate(_MACHINES)}
        with field_of(*_fleet("replay", own, {}, _SLACK_S)) as here:
            for name, both in lists.items():
                found = _ask(here, name, waits, lanes=_LANES, patience_s=_SLACK_S)
                groups[f"{name}, one server"], groups[f"{name}, two replicas"] = found[_ONE], found[_TWO]
                findings += _waiting_findings(name, found, both)
    report = Report(
        "fig5",
        "Figure 5: motion planning, one server against two",
        "sudo .venv/bin/python scripts/experiments/fig5.py",
        _SETTING,
        groups,
        findings,
        _notes(counts, timeout, planner),
        {
            "trials": ", ".join(f"{n} {count}" for n, count in counts.items()),
            "timeout, s": timeout,
            "planner": planner,
            "waits of each kind": waits,
            "the slower one is stopped": "yes" if stop else "no",
        },
    )
    if place is not None:
        names = [*counts, *lists]
        panels = {
            name: {
                case: [each.latency_s for each in groups[f"{name}, {case}"]] for case in ("one server", "two replicas")
            }
            for name in names
        }
        save_distributions(place / "fig5.png", report.title, panels, "latency, s")
    conclude(report, state, place, ["fig5.png"], as_json=as_json)


def _check(problems: Collection[str], planner: str, meshes: Path) -> None:
    """Leave with a clear word where the planner or a problem is not to be had."""
    try:
        from planning import PROBLEMS, planners
    except ImportError as error:
        missing = f"{error.name} is not installed: pip install 'gdp-ros[experiments]', or go without: --no-planning"
        raise typer.BadParameter(missing) from error
    if planner not in planners():
        raise typer.BadParameter(f"--planner {planner}: expected one of {', '.join(planners())}")
    for each in problems:
        if each not in PROBLEMS or not (meshes / f"{PROBLEMS[each]}.cfg").is_file():
            raise typer.BadParameter(
                f"--problem {each}: expected one of {', '.join(PROBLEMS)}, with its files in {meshes}"
            )


def _fleet(
    role: str, own: Mapping[str, Mapping[str, object]], options: Mapping[str, object], timeout_s: float
) -> tuple[list[Served], dict[str, Work]]:
    """Return the services and the machines' work."""
    imports = {"timeout_s": timeout_s}
    served = [Served(_TWO, TYPE, _MACHINES, options, imports), Served(_ONE, TYPE, _MACHINES[:1], {}, imports)]
    names = {each: " ".join(s.name for s in served if each in s.machines) for each in _MACHINES}
    return served, {each: Work(role, {**own[each], "services": names[each]}) for each in _MACHINES}


def _ask(here: Field, problem: str, count: int, *, lanes: int, patience_s: float) -> dict[str, list[Sample]]:
    series = Series("plan", (_ONE, _TWO), 2 * count, _MACHINES, patience_s, lanes=lanes, problem=problem)
    with Asking(here, series) as asking:
        return asking.by_service(problem)


def _planning_findings(name: str, found: Mapping[str, Sequence[Sample]]) -> list[Finding]:
    one, two = Summary.of(found[_ONE]), Summary.of(found[_TWO])
    alone = [each.latency_s for each in found[_ONE]]
    pairs = least_of_two(alone) or alone
    return [
        Finding(f"{name}: mean gain", one.mean_s / two.mean_s),
        Finding(f"{name}: p99 gain", one.p99_s / two.p99_s, paper="at most 5.53 in all problems (abstract)"),
        Finding(f"{name}: p99 gain offline, least of any two of one server's samples", p99(alone) / p99(pairs)),
    ]


def _waiting_findings(
    name: str, found: Mapping[str, Sequence[Sample]], both: Sequence[Sequence[float]]
) -> list[Finding]:
    one, two = Summary.of(found[_ONE]), Summary.of(found[_TWO])
    least = [min(each) for each in zip(*both, strict=True)]
    offline = p99(both[0]) / p99(least)
    return [
        Finding(f"{name}: mean gain", one.mean_s / two.mean_s),
        Finding(f"{name}: mean gain offline", fmean(both[0]) / fmean(least)),
        Finding(f"{name}: p99 gain", one.p99_s / two.p99_s),
        Finding(f"{name}: p99 gain offline", offline),
        Finding(f"{name}: p99 gain / p99 gain offline", one.p99_s / two.p99_s / offline, 0.95),
    ]


def _lists(count: int) -> dict[str, tuple[list[float], list[float]]]:
    """Return for each kind of wait the seconds of either machine."""
    draw = random.Random(_SEED)
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
    scale = _WAIT_MEAN_S / fmean(recorded)

    def log_normal() -> float:
        return _WAIT_MEAN_S * draw.lognormvariate(-(_SIGMA**2) / 2, _SIGMA)

    replayed = [[scale * draw.choice(recorded) for _ in range(count)] for _ in _MACHINES]
    made = [[log_normal() for _ in range(count)] for _ in _MACHINES]
    return {"Waits, Cubicles": (replayed[0], replayed[1]), "Waits, log-normal": (made[0], made[1])}


def _notes(counts: Mapping[str, int], timeout_s: float, planner: str) -> list[str]:
    told = ", ".join(f"{count} of {name}" for name, count in counts.items())
    return [
        f"The paper ran 100 trials with a timeout of 100 s; here: {told or 'none'}, timeout {timeout_s:g} s, planner"
        f" {planner}. Of fewer than a hundred trials the p99 is the slowest one. What nobody solved counts with its"
        " timeout, as failed.",
        "The replicas share two cores with each other, the robot and the overlay, and the planner calls back into"
        " Python for each collision check: gains of planning are less than those of two machines. The waits show the"
        " overlay's part.",
        "Whether the paper's planner is the same is not known here; its gains depend on how heavy the planner's tail"
        " is.",
    ]


if __name__ == "__main__":
    app()
