"""Snapshot of a supervisor for a live view: its clusters with their machines, and the latest events.

I/O: reads the journal. What changes every second, such as costs so far, is left out: a page needs no news of it.
"""

from __future__ import annotations

from typing import Final

from fog.supervisor.core.record import Record, stage
from fog.supervisor.journal import Entry, Journal

_EVENTS_MAX: Final = 40
_MACHINES_MAX: Final = 200  # of one cluster
_CLUSTERS_MAX: Final = 32


def supervisor_snapshot(journal: Journal) -> dict[str, object]:
    """Return the clusters that are up, and the newest events of all."""
    clusters = [each for each in journal.clusters() if each.is_up][:_CLUSTERS_MAX]
    rows = []
    for each in clusters:
        machines = journal.machines(each.plan.name, gone=False)
        rows.append(
            {
                "name": each.plan.name,
                "wanted": len(each.plan.machines),
                "serving": sum(machine.is_serving for machine in machines),
                "usd_per_hour": round(sum(machine.spec.offer.usd_per_hour for machine in machines), 6),
                "machines": [_machine(machine) for machine in machines[:_MACHINES_MAX]],
            }
        )
    return {
        "role": "supervisor",
        "clusters": rows,
        "events": [_event(each) for each in journal.events(last=_EVENTS_MAX)],
        "left_out": 0,
    }


def _machine(record: Record) -> dict[str, object]:
    offer = record.spec.offer
    return {
        "name": record.name,
        "stage": stage(record),
        "type": offer.type_name,
        "spot": offer.is_spot,
        "region": offer.region,
        "gateway": bool(record.gateway),
    }


def _event(entry: Entry) -> dict[str, object]:
    where = f"{entry.cluster} {entry.machine}".strip()
    return {
        "unix_s": entry.unix_s,
        "cluster": entry.cluster,
        "text": f"{where}: {entry.what}" + (f", {entry.detail}" if entry.detail else ""),
    }
