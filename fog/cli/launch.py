"""What ``fog launch`` shows before anything starts: the machines with their price, the nodes, what they offer.

Place: command; reads launch files, starts nothing.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import typer
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from fog.cluster import CloudNode
from fog.launch.load import Loaded, key_values, load
from fog.launch.probe import kept, offered
from fog.offer import Offer
from fog.plan.duration import duration_text

__all__ = ["BY_HAND", "loaded_from", "priced", "show_plan"]

MONTH_H: Final = 730.0  # as clouds reckon
BY_HAND: Final = "by fog down"


def loaded_from(path: Path, words: Sequence[str], *, dry_run: bool) -> Loaded:
    """Run a launch file as ``fog launch FILE name:=value ...`` does.

    Args:
        dry_run: start nothing, not even to find out what the nodes offer; what was found before is used.

    Raises:
        ConfigError, LocalError: see ``fog.launch.load.load``.
    """
    loaded = load(path, key_values(words), None if dry_run else offered)
    if loaded.is_known or kept(loaded.plan.nodes) is None:
        return loaded
    return load(path, key_values(words), offered)


def priced(loaded: Loaded, choice: Sequence[Offer | None]) -> dict[str, object]:
    """Return a plan with its price, as ``--json`` says it.

    Args:
        choice: for each machine of the plan what it would be; None: nothing to be had.
    """
    plan = loaded.plan
    machines = [
        {
            "hardware": wanted.hardware.to_text(),
            "spot": wanted.is_spot,
            "wanted_region": wanted.region or None,
            "provider": offer.provider if offer else None,
            "region": offer.region if offer else None,
            "type": offer.type_name if offer else None,
            "usd_per_hour": offer.usd_per_hour if offer else None,
        }
        for wanted, offer in zip(plan.machines, choice, strict=True)
    ]
    per_hour = None if None in choice else round(sum(offer.usd_per_hour for offer in choice if offer), 6)
    return {
        "cluster": plan.name,
        "nodes": [_words(node) for node in plan.nodes],
        "machines": machines,
        "usd_per_hour": per_hour,
        "usd_per_month": None if per_hour is None else round(per_hour * MONTH_H, 2),
        "budget_usd": plan.budget_usd,
        "idle_s": plan.idle_s,
        "carried": [{"kind": each.kind, "name": each.name, "type": each.type_name} for each in plan.carried]
        if loaded.is_known
        else None,
        "robot_nodes": [_words(each.node) for each in loaded.robot_nodes],
        "notes": list(loaded.notes),
    }


def show_plan(loaded: Loaded, choice: Sequence[Offer | None], ends: str = BY_HAND, *, as_json: bool) -> None:
    """Print a plan with its price, as a table or as one JSON object.

    Args:
        ends: how the cluster ends, but for its limits.
    """
    said = priced(loaded, choice)
    if as_json:
        typer.echo(json.dumps(said, ensure_ascii=False))
        return
    plan = loaded.plan
    table = Table(title=f"cluster {plan.name}", title_justify="left", title_style="bold")
    for heading in ("hardware", "kind", "region", "type", "USD/h"):
        table.add_column(heading, justify="right" if heading == "USD/h" else "left")
    for wanted, offer in zip(plan.machines, choice, strict=True):
        kind = "spot" if wanted.is_spot else "on demand"
        found = (offer.region, offer.type_name, f"{offer.usd_per_hour:.4f}") if offer else (wanted.region, "none", "-")
        table.add_row(wanted.hardware.to_text(), kind, *map(Text, found), style=None if offer else "red")
    Console(highlight=False).print(Group(table, *_lines(loaded, said, ends)))


def _lines(loaded: Loaded, said: dict[str, object], ends: str) -> list[Text]:
    plan = loaded.plan
    limits = [f"after {duration_text(plan.idle_s)} without a call"] if plan.idle_s else []
    limits += [f"after {plan.budget_usd:g} USD"] if plan.budget_usd else []
    carried = [f"{each.kind} {each.name} ({each.type_name})" for each in plan.carried]
    unknown = "found out by starting the nodes once on this machine"
    lines = [
        ("price", f"{said['usd_per_hour']} USD/h, {said['usd_per_month']} USD/month"),
        ("ends", ", ".join([ends, *limits])),
        *(("cloud", _words(node)) for node in plan.nodes),
        ("offers", ", ".join(carried) or "nothing" if loaded.is_known else unknown),
        *(("robot", _words(each.node)) for each in loaded.robot_nodes),
        *(("note", note) for note in loaded.notes),
    ]
    if said["usd_per_hour"] is None:
        lines[0] = ("price", "unknown: a machine is not to be had")
    return [Text(f"{key:<7} {value}", style="yellow" if key == "note" else "") for key, value in lines]


def _words(node: CloudNode) -> str:
    return shlex.join((node.package, node.executable, *node.arguments))
