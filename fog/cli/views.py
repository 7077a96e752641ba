"""Views of clusters, machines and events: tables for people, JSON for programs.

I/O: prints. The views themselves are computed without I/O.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Final

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from fog.hardware import HOURS_A_MONTH
from fog.latency.known import NO_ENDPOINT, Latency
from fog.plan.duration import duration_text
from fog.supervisor.core.record import Record, cost_usd, stage
from fog.supervisor.journal import Cluster, Entry
from gdp.cli.console import console, folding
from gdp.printable import escaped
from gdp.terminal import echo

_STYLES: Final = {
    "serving": "green",
    "unreachable": "red",
    "preempted": "red",
    "failed": "red",
    "refused": "red",
    "trouble": "red",
    "alarm": "red",
    "notice": "yellow",
    "draining": "yellow",
    "leaving": "yellow",
    "orphan": "yellow",
    "gone": "dim",
    "released": "dim",
}


def machine_fields(
    record: Record, now_s: float, latency_ms: Mapping[str, float] | None = None, *, is_watched: bool = True
) -> dict[str, object]:
    """Return a machine's fields of the JSON output; ``latency_ms``: known latencies by region."""
    offer = record.spec.offer
    return {
        "name": record.name,
        "stage": stage(record, is_watched=is_watched),
        "serving": record.is_serving,
        "gateway": record.gateway if record.gateway and not record.is_gone else None,
        "region": offer.region,
        "latency_ms": (latency_ms or {}).get(offer.region),
        "type": offer.type_name,
        "spot": offer.is_spot,
        "provider": offer.provider,
        "id": record.id,
        "address": record.address,
        "usd_per_hour": offer.usd_per_hour,
        "usd": round(cost_usd(record, now_s), 6),
        "asked_unix_s": record.asked_unix_s,
        "served_unix_s": record.served_unix_s,
        "gone_unix_s": record.gone_unix_s,
        "reason": record.reason,
    }


def cluster_fields(cluster: Cluster, records: Sequence[Record], now_s: float) -> dict[str, object]:
    """Return a cluster's fields of the JSON output; ``records``: all its machines, also those that are gone."""
    plan = cluster.plan
    live = [each for each in records if not each.is_gone]
    return {
        "name": plan.name,
        "up": cluster.is_up,
        "why": cluster.why,
        "wanted": len(plan.machines) if cluster.is_up else 0,
        "serving": sum(each.is_serving for each in live),
        "machines": len(live),
        "usd_per_hour": round(sum(each.spec.offer.usd_per_hour for each in live), 6),
        "carried": [{"kind": each.kind, "name": each.name, "type": each.type_name} for each in plan.carried],
        "since_unix_s": cluster.begun_unix_s,
        "age_s": round(now_s - cluster.begun_unix_s, 1),
    }


def cost_fields(cluster: Cluster, records: Sequence[Record], now_s: float) -> dict[str, object]:
    """Return the cost of a cluster until now and its present cost."""
    per_hour = sum(each.spec.offer.usd_per_hour for each in records if not each.is_gone)
    spent = sum(cost_usd(each, now_s) for each in records)
    this = sum(cost_usd(each, now_s) for each in records if each.asked_unix_s >= cluster.begun_unix_s)
    return {
        "name": cluster.plan.name,
        "usd": round(this, 6),
        "usd_ever": round(spent, 6),
        "usd_per_hour": round(per_hour, 6),
        "usd_per_month": round(per_hour * HOURS_A_MONTH, 2),
        "budget_usd": cluster.plan.budget_usd,
        "machines": len(records),
    }


def clusters_table(rows: Sequence[Mapping[str, object]]) -> Table:
    """Return a line for each cluster."""
    table = _table("cluster", "state", "serving", "machines", "USD/h", "since", "offers")
    for row in rows:
        names = [str(each["name"]) for each in row["carried"]] if isinstance(row["carried"], list) else []
        is_whole = row["serving"] == row["wanted"]
        state = Text("up", style="green" if is_whole else "yellow") if row["up"] else Text(f"down: {row['why']}", "dim")
        table.add_row(
            str(row["name"]),
            state,
            f"{row['serving']}/{row['wanted']}",
            str(row["machines"]),
            f"{row['usd_per_hour']:.4f}",
            _moment(row["since_unix_s"]),
            ", ".join(names),
        )
    return table


def machines_table(rows: Sequence[Mapping[str, object]], now_s: float) -> Table:
    """Return a line for each machine."""
    table = _table("machine", "stage", "gateway", "region", "ms", "type", "kind", "USD/h", "age", "address", "")
    for row in rows:
        began = float(str(row["asked_unix_s"]))
        age = (now_s if row["gone_unix_s"] is None else float(str(row["gone_unix_s"]))) - began
        table.add_row(
            str(row["name"]),
            Text(str(row["stage"]), style=_STYLES.get(str(row["stage"]), "")),
            str(row["gateway"] or "-"),
            str(row["region"]),
            "-" if row["latency_ms"] is None else f"{row['latency_ms']:g}",
            str(row["type"]),
            "spot" if row["spot"] else "on demand",
            f"{row['usd_per_hour']:.4f}",
            duration_text(max(round(age), 1)),
            str(row["address"]) or "-",
            escaped(str(row["reason"])),
        )
    return table


def costs_table(rows: Sequence[Mapping[str, object]]) -> Table:
    """Return a line for each cluster."""
    table = _table("cluster", "USD", "USD ever", "USD/h now", "USD/month", "budget")
    for row in rows:
        table.add_row(
            str(row["name"]),
            f"{row['usd']:.4f}",
            f"{row['usd_ever']:.4f}",
            f"{row['usd_per_hour']:.4f}",
            f"{row['usd_per_month']:.2f}",
            "-" if row["budget_usd"] is None else f"{row['budget_usd']:.2f}",
        )
    return table


def events_table(entries: Sequence[Entry]) -> Table:
    """Return a line for each event."""
    table = _table("time", "cluster", "machine", "what", "")
    for entry in entries:
        what = Text(entry.what, style=_STYLES.get(entry.what, ""))
        table.add_row(_moment(entry.unix_s, "%H:%M:%S.%f")[:-3], entry.cluster, entry.machine, what, _detail(entry))
    return table


def event_line(entry: Entry) -> Text:
    """Return one event as a line of text."""
    time = _moment(entry.unix_s, "%H:%M:%S.%f")[:-3]
    return Text.assemble(
        (time, "dim"),
        f" {entry.machine or entry.cluster:<8} ",
        (entry.what, _STYLES.get(entry.what, "")),
        f"  {_detail(entry)}",
    )


def _detail(entry: Entry) -> Text:
    words = [entry.detail] if entry.detail else []
    if entry.lines:
        words.append(f"of {entry.detail}: {entry.lines.splitlines()[-1]}")
        del words[0]
    elif entry.since_unix_s is not None and entry.what != "reconciled":
        words.append(f"seen after {entry.unix_s - entry.since_unix_s:.2f} s")
    return Text(escaped("; ".join(words)))


def show(*parts: RenderableType) -> None:
    """Print tables."""
    shown = console()
    if shown.is_terminal:
        for part in parts:
            shown.print(part)
        return
    with shown.capture() as captured:  # a table fills its last column with blanks
        for part in parts:
            shown.print(part)
    echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


def print_event(entry: Entry, out: Console, *, as_json: bool) -> None:
    """Print one event as it happens: as JSON, or as a line of text on ``out``."""
    if as_json:
        print_json(entry)
    else:
        out.print(event_line(entry))


def print_json(value: object) -> None:
    """Print one JSON value."""
    echo(json.dumps(value, ensure_ascii=False, default=asdict))


def ms_text(latency: Latency) -> str:
    """Return a latency as tables show it."""
    return "-" if latency.ms is None else f"{latency.ms:g}"


def latency_lines(latencies: Mapping[str, Latency]) -> list[str]:
    """Return the sources of the figures, regions with the same source on one line."""
    if all(each.source == NO_ENDPOINT for each in latencies.values()):
        return [NO_ENDPOINT]
    sources: dict[str, list[str]] = {}
    for region, each in sorted(latencies.items()):
        sources.setdefault(each.source, []).append(region if each.ms is None else f"{region} {each.ms:g} ms")
    return [f"{', '.join(regions)}: {source}" for source, regions in sources.items()]


def _table(*headings: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in headings:
        table.add_column(heading, justify="right" if heading.startswith("USD") else "left")
    return folding(table)


def _moment(unix_s: object, form: str = "%Y-%m-%d %H:%M") -> str:
    return datetime.fromtimestamp(float(str(unix_s))).strftime(form)
