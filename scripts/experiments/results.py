"""Table of the papers' figures: theirs, ours, trials, spread, conditions, origin; from the experiments' JSON.

Reads the JSON files of a folder; otherwise sans-I/O.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Any, Final

import numpy as np
from machine import MachineState
from offload_page import CDR, CYCLONE, JSON, PAPER, PAPER_ADDED_S, added_s, seconds_text, share_text
from page_text import PAPERS, text_of
from report import markdown_table
from samples import p99

THIS_RUN: Final = "this run"

_RESAMPLES: Final = 2_000
_SEED: Final = 1
_CASES: Final = ("one server", "two replicas")
_GAINS: Final = PAPERS["gains"]
_NUMBERS: Final = {"fig5": "FT Figure 5", "fig6": "FT Figure 6", "fig7": "FT Figure 7"}


@dataclass(frozen=True, slots=True)
class Row:
    """Figure of a paper and ours, as text.

    ``spread``: of ours, with its definition. ``measured``: ``THIS_RUN``, or day, commit and load of an earlier one;
    also of this one where the load was high.
    """

    figure: str
    what: str
    paper: str
    here: str
    spread: str
    trials: str
    conditions: str
    measured: str = ""


def rows_of(folder: Path, measured: Collection[str]) -> tuple[list[Row], list[str]]:
    """Return the rows of those experiments whose JSON is in a folder, and the names of the others.

    ``measured``: experiments that wrote their JSON in this run.
    """
    makers: dict[str, Callable[[Any], Iterator[Row]]] = {
        "offload": _offload,
        "table1": _prices,
        "fig4": _uplink,
        **{name: lambda document, name=name: _gains(name, document) for name in _GAINS},  # type: ignore[misc]
        "fig9": _kills,
        "outages": _outages,
    }
    rows: list[Row] = []
    missing = []
    for name, make in makers.items():
        path = folder / f"{name}.json"
        if path.exists():
            document = json.loads(path.read_text(encoding="utf-8"))
            origin = _origin(document, is_measured=name in measured)
            rows += (replace(row, measured=origin) for row in make(document))
        else:
            missing.append(name)
    return rows, missing


def machines_of(folder: Path) -> list[str]:
    """Return the machine of each experiment, and its load, from the JSON in a folder."""
    found: dict[str, list[str]] = {}
    for name in ("offload", "fig4", *_GAINS, "fig9", "outages"):
        path = folder / f"{name}.json"
        if path.exists():
            document = json.loads(path.read_text(encoding="utf-8"))
            for state in _states(document):
                machine = f"Linux {state.kernel}, {state.cores} cores ({state.processor})"
                found.setdefault(machine, []).append(f"{name} {state.load_before:.1f}")
    return [f"{machine}; load before: {', '.join(loads)}." for machine, loads in found.items()]


def _states(document: Any) -> list[MachineState]:
    """Return the machine of each part of a document, with its load before; none where it was not recorded."""
    parts = [part for task in document.get("tasks", {}).values() for part in task.values()] or [document]
    return [MachineState(**part["machine"]) for part in parts if "machine" in part]


def _origin(document: Any, *, is_measured: bool) -> str:
    """Return where the rows of a document come from."""
    states = _states(document)
    busy = max(states, key=lambda state: state.load_before / state.cores, default=None)
    if is_measured:
        return THIS_RUN + (busy.mark if busy else "")
    codes = " and ".join(dict.fromkeys(state.code for state in states)) or "day and commit not recorded"
    return f"earlier: {codes}, " + (f"load {busy.load_before:.1f}" if busy else "load not recorded")


def page_of(rows: Sequence[Row], machines: Sequence[str], missing: Sequence[str]) -> str:
    """Return the page, in Markdown. ``missing``: experiments that have no rows."""
    head = ("figure", "what", "paper", "here", "spread here", "trials here", "conditions here", "measured")
    cells = [(r.figure, r.what, r.paper, r.here, r.spread, r.trials, r.conditions, r.measured) for r in rows]
    text = text_of(
        "papers",
        missing=f"**Not complete.** Not measured: {', '.join(missing)}.\n\n" if missing else "",
        table=markdown_table(head, cells),
        resamples=_RESAMPLES,
        machines="\n".join(f"- {machine}" for machine in machines),
    )
    return f"{text}\n"


def _offload(document: Any) -> Iterator[Row]:
    tasks = {name: document["tasks"][name] for name in PAPER if name in document["tasks"]}
    for name, task in tasks.items():
        paper, network = PAPER[name], task["network"]
        where = share_text(task["alone"]["cores"])
        where += "" if task["alone"]["cores"] == 1 else ", the paper's ratio"
        yield _seconds("G Table I", f"{name}: robot only", paper.alone_s, task["alone"]["took_s"], where)
        for who, network_s, total_s in (
            (CYCLONE, paper.ros_network_s, paper.ros_total_s),
            (JSON, paper.network_s, paper.total_s),
            (CDR, paper.network_s, paper.total_s),
        ):
            found, hops = network["contenders"][who], "three bridges" if who == CYCLONE else network["over"]
            yield _seconds("G Table I", f"{name}: {who}, network one way", network_s, found["there_s"], hops)
            yield _seconds("G Table I", f"{name}: {who}, total", total_s, found["total_s"], f"{hops}; computed")
    for who in (JSON, CDR):
        middles = []
        for name, task in tasks.items():
            network = task["network"]
            middle, least, most = added_s(network, who, CYCLONE)
            middles.append(middle)
            yield Row(
                "G Figure 5",
                f"{name}: {who}, added to Cyclone DDS",
                f"{PAPER[name].network_s - PAPER[name].ros_network_s:.3f} s",
                f"{middle:.4f} s",
                f"{least:.4f} to {most:.4f} s, rounds",
                f"{network['rounds']} x {network['answered_at_once'] // network['rounds']}",
                "one way",
            )
        average = f"{fmean(middles):.4f} s"
        yield Row("G Figure 5", f"{who}, added on average", f"{PAPER_ADDED_S} s", average, "", "", "one way")


def _prices(document: Any) -> Iterator[Row]:
    for each in document["applications"]:
        paper, here = (" / ".join(f"{usd:.2f}" for usd in each[key]) for key in ("paper", "usd_per_hour"))
        what = f"{each['name']}: one on-demand / two / two spot, USD an hour"
        yield Row(
            "FT Table I", what, paper, here, "", "", f"{each['on_demand'][0]}, {each['on_demand'][1]}; list of 2024"
        )


def _uplink(document: Any) -> Iterator[Row]:
    settings = document["settings"]
    for each in document["findings"]:
        if each["paper"]:
            conditions = f"{settings['replicas']} replicas, frames of 307,200 bytes"
            here = f"{each['measured']:.2f}"
            yield Row("FT Figure 4", each["what"], each["paper"], here, "", str(settings["requests"]), conditions)


def _gains(name: str, document: Any) -> Iterator[Row]:
    for group, (what, mean_gain, p99_gain, conditions) in _GAINS[name].items():
        keys = [f"{group}, {case}" for case in _CASES]
        if name == "fig7":
            keys = [f"{case}, {group}" for case in _CASES]
        if not all(key in document["groups"] for key in keys):
            continue
        one, two = ([sample[0] for sample in document["groups"][key]] for key in keys)
        for label, paper, of in (("mean", mean_gain, fmean), ("p99", p99_gain, p99)):
            low, high = _interval(one, two, of)
            gain = f"{of(one) / of(two):.2f}"
            yield Row(
                _NUMBERS[name],
                f"{what}: {label} gain",
                paper,
                gain,
                f"{low:.2f} to {high:.2f}",
                str(len(one)),
                conditions,
            )


def _kills(document: Any) -> Iterator[Row]:
    found = {each["what"]: each["measured"] for each in document["findings"]}
    samples = document["groups"]["all"]
    times = [sample[0] for sample in samples]
    conditions = (
        f"{found['kills']:.0f} kills (SIGKILL), in turn; {document['settings']['requests a second']:g} requests/s"
    )
    unanswered = f"{found['failed requests']:.0f}"
    spread = f"p50 {median(times):.1f} ms, p99 {p99(times):.1f} ms"
    yield Row("FT Figure 9", "requests unanswered", "0", unanswered, spread, str(len(samples)), conditions)


def _outages(document: Any) -> Iterator[Row]:
    found = {each["what"]: each["measured"] for each in document["findings"]}
    arithmetic = found["two machines: by arithmetic, 15 h up and 20 min down, %"]
    yield Row(
        "FT availability", "two down together, 15 h and 20 min", "< 0.05 %", f"{arithmetic:.3f} %", "", "", "arithmetic"
    )
    for label in ("one machine", "two machines"):
        listed = found[f"{label}: by the list, %"]
        yield Row(
            "FT availability",
            f"{label}, 9 s up and 3 s down: requests unanswered",
            "",
            f"{found[f'{label}: requests unanswered, %']:.1f} %",
            f"{listed:.1f} % by the times drawn",
            str(len(document["groups"][label])),
            "machines stop at random",
        )


def _seconds(figure: str, what: str, paper_s: float, times: Sequence[float], conditions: str) -> Row:
    low, high = min(times), max(times)
    spread = f"{seconds_text(low)} to {seconds_text(high)} s"
    return Row(figure, what, f"{paper_s:g} s", f"{seconds_text(median(times))} s", spread, str(len(times)), conditions)


def _interval(
    one: Sequence[float], two: Sequence[float], of: Callable[[Sequence[float]], float]
) -> tuple[float, float]:
    """Return the 95 % interval of the ratio of a figure of two samples, by resampling both."""
    chance = np.random.default_rng(_SEED)
    a, b = np.asarray(one), np.asarray(two)
    draws = ((chance.choice(a, len(a)).tolist(), chance.choice(b, len(b)).tolist()) for _ in range(_RESAMPLES))
    ratios = [of(mine) / of(other) for mine, other in draws]
    low, high = np.quantile(ratios, (0.025, 0.975))
    return float(low), float(high)
