"""Output of ``fog launch`` before the start: machines with their price, nodes, and exported interfaces.

I/O; reads launch files and starts nothing.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rich.console import Group
from rich.table import Table
from rich.text import Text

from fog.cli.views import latency_lines, ms_text
from fog.cluster import CloudNode
from fog.hardware import HOURS_A_MONTH, Offer
from fog.latency.known import Latency
from fog.launch.interface_discovery import kept, offered
from fog.launch.load import Loaded, key_values, load
from fog.plan.duration import duration_text
from fog.plan.target import Target
from fog.topology import Gateway
from gdp.cli.console import console
from gdp.terminal import echo

BY_HAND: Final = "by fog down"


def loaded_from(path: Path, words: Sequence[str], *, dry_run: bool) -> Loaded:
    """Run a launch file as ``fog launch FILE name:=value ...`` does.

    Args:
        dry_run: start no process; interface discovery uses cached results only.
    """
    loaded = load(path, key_values(words), None if dry_run else offered)
    if loaded.is_known or kept(loaded.plan.nodes) is None:
        return loaded
    return load(path, key_values(words), offered)


@dataclass(frozen=True, slots=True)
class Priced:
    """A launch file's plan with the offers chosen for its machines.

    Args:
        target: result for the plan's availability; None: the plan has no availability.
        topology: the gateways to the machines; None: their provider has none.
    """

    loaded: Loaded
    choice: Sequence[Offer | None]
    latencies: Mapping[str, Latency]
    target: Target | None = None
    topology: Gateway | None = None

    def gateway(self, offer: Offer | None) -> Gateway | None:
        """Return the gateway of a machine; None: there is none."""
        return self.topology.serving(offer.region) if self.topology is not None and offer is not None else None


def priced(said: Priced) -> dict[str, object]:
    """Return a plan with its price, as ``--json`` prints it."""
    plan = said.loaded.plan
    machines = [
        {
            "hardware": wanted.hardware.to_text(),
            "spot": wanted.is_spot,
            "wanted_region": wanted.region or None,
            "provider": offer.provider if offer else None,
            "region": offer.region if offer else None,
            "type": offer.type_name if offer else None,
            "usd_per_hour": offer.usd_per_hour if offer else None,
            "latency_ms": said.latencies[offer.region].ms if offer else None,
            "latency_source": said.latencies[offer.region].source if offer else None,
            "gateway": {"name": gateway.gateway, "replica": gateway.replica}
            if (gateway := said.gateway(offer)) is not None
            else None,
        }
        for wanted, offer in zip(plan.machines, said.choice, strict=True)
    ]
    per_hour = None if None in said.choice else round(sum(offer.usd_per_hour for offer in said.choice if offer), 6)
    target = said.target
    return {
        "cluster": plan.name,
        "nodes": [_words(node) for node in plan.nodes],
        "machines": machines,
        "latencies": {region: asdict(each) for region, each in said.latencies.items()},
        "usd_per_hour": per_hour,
        "usd_per_month": None if per_hour is None else round(per_hour * HOURS_A_MONTH, 2),
        "budget_usd": plan.budget_usd,
        "idle_s": plan.idle_s,
        "scale": None if plan.scale is None else plan.scale.to_keys(),
        "availability": target
        and {
            "target": target.availability,
            "replicas": len(target.machines),
            "p_vm": target.p_vm,
            "p_system": target.p_system,
            "assumptions": list(target.assumptions),
        },
        "carried": [{"kind": each.kind, "name": each.name, "type": each.type_name} for each in plan.carried]
        if said.loaded.is_known
        else None,
        "robot_nodes": [_words(each.node) for each in said.loaded.robot_nodes],
        "notes": list(said.loaded.notes),
    }


def show_plan(said: Priced, ends: str = BY_HAND, *, as_json: bool) -> None:
    """Print a plan with its price, as a table or as one JSON object.

    Args:
        ends: how the cluster ends, apart from its limits.
    """
    fields = priced(said)
    if as_json:
        echo(json.dumps(fields, ensure_ascii=False))
        return
    plan = said.loaded.plan
    table = Table(title=f"cluster {plan.name}", title_justify="left", title_style="bold")
    for heading in ("hardware", "kind", "region", "ms", "type", "USD/h"):
        table.add_column(heading, justify="right" if heading in ("ms", "USD/h") else "left")
    for wanted, offer in zip(plan.machines, said.choice, strict=True):
        kind = "spot" if wanted.is_spot else "on demand"
        found = (wanted.region, "-", "none", "-")
        if offer:
            found = offer.region, ms_text(said.latencies[offer.region]), offer.type_name, f"{offer.usd_per_hour:.4f}"
        table.add_row(wanted.hardware.to_text(), kind, *map(Text, found), style=None if offer else "red")
    console().print(Group(table, *_lines(said, fields, ends)))


def _lines(said: Priced, fields: dict[str, object], ends: str) -> list[Text]:
    plan, loaded, target = said.loaded.plan, said.loaded, said.target
    limits = [f"after {duration_text(plan.idle_s)} without a call"] if plan.idle_s else []
    limits += [f"after {plan.budget_usd:g} USD"] if plan.budget_usd else []
    scale = plan.scale
    carried = [f"{each.kind} {each.name} ({each.type_name})" for each in plan.carried]
    unknown = "found out by starting the nodes once on this machine"
    replicas = {each.gateway: None for each in map(said.gateway, said.choice) if each is not None and each.replica}
    lines = [
        ("price", f"{fields['usd_per_hour']} USD/h, {fields['usd_per_month']} USD/month"),
        ("ends", ", ".join([ends, *limits])),
        *([] if scale is None else [("scale", f"{scale.min_machines} to {scale.max_machines} machines")]),
        *(("latency", line) for line in latency_lines(said.latencies)),
        *(("gateway", f"{name}: one of these machines") for name in replicas),
        *(("cloud", _words(node)) for node in plan.nodes),
        ("offers", ", ".join(carried) or "nothing" if loaded.is_known else unknown),
        *(("robot", _words(each.node)) for each in loaded.robot_nodes),
        *(("note", note) for note in loaded.notes),
    ]
    if target is not None:
        reached = f"{len(target.machines)} replicas: none is up {target.p_system:.4%} of the time"
        lines.insert(1, ("target", f"{target.availability:.6g} available; {reached}"))
        lines += [("assumed", line) for line in target.assumptions]
    if fields["usd_per_hour"] is None:
        lines[0] = ("price", "unknown: a machine is not to be had")
    return [Text(f"{key:<7} {value}", style="yellow" if key == "note" else "") for key, value in lines]


def _words(node: CloudNode) -> str:
    return shlex.join((node.package, node.executable, *node.arguments))
