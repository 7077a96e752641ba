"""Page and picture of ``offload.py``: FogROS G's Table I and Figure 5, ours below the paper's.

Sans-I/O, but for the picture's file.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from machine import MachineState
from page_text import text_of
from report import markdown_table, percentile

CYCLONE: Final = "ROS 2, Cyclone DDS"
FAST: Final = "ROS 2, Fast DDS"
JSON: Final = "overlay, JSON"
CDR: Final = "overlay, CDR"
_CELLS: Final = ("network", "total")
_SHOWN: Final = (CYCLONE, JSON, CDR)  # in Table I
_COLOURS: Final = {CYCLONE: "#99a8b2", FAST: "#5d6b75", JSON: "#7fb3c4", CDR: "#1f6f8b"}
PAPER_ADDED_S: Final = 0.014
# What the tasks compute here, and how far that is from what the paper computed.
COMPUTES: Final = {
    "vSLAM": "RGB-D visual odometry with ORB features; stand-in for ORB-SLAM2: no map, no loop closure",
    "motion planning": "OMPL's RRTConnect with FCL in Home, one thread; the paper: MPT, a parallel planner",
    "grasp planning": "antipodal sampling on the depth image; stand-in for Dex-Net: no neural network ranks",
}


@dataclass(frozen=True, slots=True)
class PaperRow:
    """Row of the paper's Table I, in seconds."""

    alone_s: float
    ros_network_s: float
    ros_total_s: float
    network_s: float
    total_s: float


PAPER: Final = {
    "vSLAM": PaperRow(0.68, 0.010, 1.4, 0.024, 1.4),
    "motion planning": PaperRow(161.8, 0.008, 4.3, 0.023, 4.3),
    "grasp planning": PaperRow(14.0, 0.065, 0.6, 0.089, 0.6),
}

Document = Mapping[str, Any]  # JSON


def added_s(network: Document, overlay: str, other: str) -> tuple[float, float, float]:
    """Return the network time that the overlay adds to ROS 2: median, least and most of the rounds.

    ``overlay``: ``JSON`` or ``CDR``. ``other``: ``CYCLONE`` or ``FAST``.
    """
    ours, theirs = (network["contenders"][who]["rounds_there_s"] for who in (overlay, other))
    gaps = [a - b for a, b in zip(ours, theirs, strict=True)]
    return statistics.median(gaps), min(gaps), max(gaps)


def page_of(document: Document) -> str:
    """Return the page, in Markdown, of the measured tasks."""
    tasks: Document = document["tasks"]
    networks = {name: task["network"] for name, task in tasks.items()}
    text = text_of(
        "offload",
        table1=markdown_table(
            ("scenario", "", "robot only", *(f"{who} {what}" for who in ("ROS 2", JSON, CDR) for what in _CELLS)),
            [row for name in PAPER if name in tasks for row in _rows(name, tasks[name])],
        ),
        figure5=_figure5(networks),
        details=_details(networks),
        trials="; ".join(_trials(name, each) for name, each in networks.items()),
        computes="\n- ".join(f"{name}: {COMPUTES[name]}." for name in PAPER if name in tasks),
        ratios=", ".join(f"{name} {each:.2f}" for name, each in document["slower"].items()),
        machines="\n- ".join(
            f"{name}, {part}: measured on {MachineState(**each['machine'])}."
            for name, task in tasks.items()
            for part, each in task.items()
        ),
    )
    return f"{text}\n"


def save_picture(path: Path, document: Document) -> None:
    """Draw network time by baseline and task, and next to it the time that the overlay adds."""
    from pictures import plt, save, tidy

    networks = {name: each["network"] for name, each in document["tasks"].items()}
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
    for at, who in enumerate(_COLOURS):
        times = [1e3 * statistics.median(network["contenders"][who]["there_s"]) for network in networks.values()]
        places = [place + (at - 1.5) * 0.21 for place in range(len(networks))]
        left.bar(places, times, 0.19, color=_COLOURS[who], label=who)
    names = list(networks)
    paper = [1e3 * PAPER[name].network_s for name in names]
    left.plot(range(len(names)), paper, "_", ms=30, color="#c96f3b", label="FogROS G, the paper")
    left.set_xticks(range(len(names)), names, fontsize=8)
    left.set_title("network, one way, ms (median)", loc="left", fontsize=10)
    for at, who in enumerate((JSON, CDR)):
        added = [added_s(network, who, CYCLONE) for network in networks.values()]
        spread = [[1e3 * (a - low) for a, low, _ in added], [1e3 * (high - a) for a, _, high in added]]
        places = [place + (at - 0.5) * 0.4 for place in range(len(names))]
        right.bar(places, [1e3 * a for a, _, _ in added], 0.38, yerr=spread, color=_COLOURS[who], label=who)
    right.axhline(1e3 * PAPER_ADDED_S, color="#c96f3b", ls="--", lw=0.8, label="FogROS G, average")
    right.set_xticks(range(len(names)), names, fontsize=8)
    right.set_title("overlay less ROS 2 on Cyclone DDS, ms; whiskers: rounds", loc="left", fontsize=10)
    for axis in (left, right):
        tidy(axis)
    save(figure, path)


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
        f" {network['computed']} computed (computed, total), the overlay over {network['over']}, {_cores_text(network)}"
    )


def _cores_text(network: Document) -> str:
    if network["cores"] is None:
        return "machines share all cores"
    return "cores by control groups: " + ", ".join(f"{node} {count}" for node, count in network["cores"].items())


def share_text(cores: float) -> str:
    """Return the share of a core that a robot has."""
    return "one core" if cores == 1 else f"1/{1 / cores:.0f} of a core"


def _text(values: Sequence[float]) -> str:
    return f"{seconds_text(statistics.median(values))} ({seconds_text(percentile(values, 0.99))})"


def seconds_text(value: float) -> str:
    """Return seconds with three digits, or four decimals."""
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}" if value >= 1 else f"{value:.4f}"
