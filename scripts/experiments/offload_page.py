"""Page and picture of ``offload.py``: FogROS G's Table I and Figure 5, ours below the paper's. Sans-I/O."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from experiment import PAPERS
from machine import MachineState
from plot import Bar, Panel
from report import markdown_table, percentile

CYCLONE: Final = "ROS 2, Cyclone DDS"
FAST: Final = "ROS 2, Fast DDS"
JSON: Final = "overlay, JSON"
CDR: Final = "overlay, CDR"
_CELLS: Final = ("network", "total")
_SHOWN: Final = (CYCLONE, JSON, CDR)  # in Table I
PAPER_ADDED_S: Final = 0.014
COMPUTES: Final[Mapping[str, str]] = PAPERS["computes"]


@dataclass(frozen=True, slots=True)
class PaperRow:
    """Row of the paper's Table I, in seconds."""

    alone_s: float
    ros_network_s: float
    ros_total_s: float
    network_s: float
    total_s: float


PAPER: Final = {name: PaperRow(**row) for name, row in PAPERS["offload"].items()}

Document = Mapping[str, Any]  # JSON


def added_s(network: Document, overlay: str, other: str) -> tuple[float, float, float]:
    """Return the network time that the overlay adds to ROS 2: median, least and most of the rounds.

    ``overlay``: ``JSON`` or ``CDR``. ``other``: ``CYCLONE`` or ``FAST``.
    """
    ours, theirs = (network["contenders"][who]["rounds_there_s"] for who in (overlay, other))
    gaps = [a - b for a, b in zip(ours, theirs, strict=True)]
    return statistics.median(gaps), min(gaps), max(gaps)


def figures_of(document: Document) -> dict[str, object]:
    """Return the figures and tables in the page's text, of the measured tasks."""
    tasks: Document = document["tasks"]
    networks = {name: task["network"] for name, task in tasks.items()}
    return {
        "table1": markdown_table(
            ("scenario", "", "robot only", *(f"{who} {what}" for who in ("ROS 2", JSON, CDR) for what in _CELLS)),
            [row for name in PAPER if name in tasks for row in _rows(name, tasks[name])],
        ),
        "figure5": _figure5(networks),
        "details": _details(networks),
        "trials": "; ".join(_trials(name, each) for name, each in networks.items()),
        "computes": "\n- ".join(f"{name}: {COMPUTES[name]}." for name in PAPER if name in tasks),
        "ratios": ", ".join(f"{name} {each:.2f}" for name, each in document["slower"].items()),
        "machines": "\n- ".join(
            f"{name}, {part}: measured on {MachineState(**each['machine'])}."
            for name, task in tasks.items()
            for part, each in task.items()
        ),
    }


def panels_of(document: Document) -> list[Panel]:
    """Return for each task a panel of network times, and next to it one of the time that the overlay adds."""
    panels = []
    for name, task in document["tasks"].items():
        network, paper = task["network"], PAPER[name]
        times = {who: statistics.median(each["there_s"]) for who, each in network["contenders"].items()}
        bars = [Bar(who, 1e3 * time_s, ours=who in (JSON, CDR)) for who, time_s in times.items()]
        bars.append(Bar("FogROS G, the paper", 1e3 * paper.network_s, ours=False))
        panels.append(Panel(f"{name}: network, one way", "ms, median", bars))
        added = {who: [1e3 * each for each in added_s(network, who, CYCLONE)] for who in (JSON, CDR)}
        bars = [Bar(who, middle, least, most) for who, (middle, least, most) in added.items()]
        bars.append(Bar("FogROS G, average", 1e3 * PAPER_ADDED_S, ours=False))
        panels.append(Panel(f"{name}: overlay less ROS 2 on Cyclone DDS", "ms; whiskers: rounds", bars))
    return panels


def _rows(name: str, task: Document) -> list[tuple[str, ...]]:
    paper = PAPER[name]
    theirs = (paper.alone_s, paper.ros_network_s, paper.ros_total_s, paper.network_s, paper.total_s)
    mark = "".join(dict.fromkeys(MachineState(**part["machine"]).mark for part in task.values()))
    found = [task["network"]["contenders"][who] for who in _SHOWN]
    alone = f"{_text(task['alone']['took_s'])}, {share_text(task['alone']['cores'])}"
    there = [_text(each[key]) for each in found for key in ("there_s", "total_s")]
    back = [cell for each in found for cell in (_text(each["back_s"]), "")]
    return [
        (name, "paper", *(f"{each:g}" for each in theirs), "", ""),
        ("", f"here, there{mark}", alone, *there),
        ("", f"here, back{mark}", "", *back),
    ]


def _figure5(networks: Document) -> str:
    pairs = [(overlay, other) for overlay in (JSON, CDR) for other in (CYCLONE, FAST)]
    added = {name: [added_s(network, *pair) for pair in pairs] for name, network in networks.items()}
    rows = []
    for name, network in networks.items():
        cells = [f"{middle:.4f} ({least:.4f} to {most:.4f})" for middle, least, most in added[name]]
        paper_s = PAPER[name].network_s - PAPER[name].ros_network_s
        rows.append((name, f"{network['request_bytes']:,}", *cells, f"{paper_s:.3f}"))
    means = [f"{statistics.fmean(each[0] for each in column):+.4f}" for column in zip(*added.values(), strict=True)]
    rows.append(("mean of the tasks", "", *means, f"{PAPER_ADDED_S:+g}"))
    head = ("scenario", "request, bytes", *(f"{overlay} less {other}" for overlay, other in pairs), "paper")
    return markdown_table(head, rows)


def _details(networks: Document) -> str:
    rows = []
    for name, network in networks.items():
        for who, each in network["contenders"].items():
            cells = (_text(each[key]) for key in ("there_s", "back_s", "computed_s", "total_s"))
            rows.append((name, who, *cells, str(each["failed"])))
    head = ("scenario", "", "there", "back", "computed", "total", "wrong answers")
    return markdown_table(head, rows)


def _trials(name: str, network: Document) -> str:
    return (
        f"{name}: {network['rounds']} rounds, {network['answered_at_once']} requests answered at once (there, back) and"
        f" {network['computed']} computed (computed, total), the overlay over {network['over']}, machines share all"
        " cores"
    )


def share_text(cores: float) -> str:
    """Return the share of a core that a robot has."""
    return "one core" if cores == 1 else f"1/{1 / cores:.0f} of a core"


def _text(values: Sequence[float]) -> str:
    return f"{seconds_text(statistics.median(values))} ({seconds_text(percentile(values, 0.99))})"


def seconds_text(value: float) -> str:
    """Return seconds with three digits, or four decimals."""
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}" if value >= 1 else f"{value:.4f}"
