"""Status of a node for ``gdp status``: identity, uptime and counters."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from gdp.crypto.identity import Identity
from gdp.state.tables import rounded_ms
from gdp.telemetry.sources import NeighbourRow, Sources

_ROWS: Final = ("clocks", "entries", "latency", "links", "ports", "topics", "health")  # no counters


def node_status(identity: Identity, sources: Sources, *, uptime_s: float, **more: object) -> dict[str, object]:
    """Return the JSON fields of a node.

    Args:
        sources: of its metrics; counters with labels become mappings.
        more: fields of one kind of node.
    """
    counters: dict[str, object] = {}
    for each in fields(sources):
        source = getattr(sources, each.name)
        if each.name == "drops":
            counters["drops"] = 0 if source is None else sum(source().values())
        elif source is not None and each.name not in _ROWS:
            value = source()
            counters[each.name] = value if isinstance(value, int | float) else dict(value)
    return {
        "role": identity.role.value,
        "label": identity.member.label,
        "name": identity.name.to_text(),
        "uptime_s": round(uptime_s, 1),
        **more,
        "counters": counters,
    }


def link_status(row: NeighbourRow) -> dict[str, object]:
    """Return the JSON fields of a link; ``rtt_ms`` is None before the first measurement."""
    return {
        "port": row.port,
        "neighbour": row.name.short,
        "rtt_ms": rounded_ms(row.rtt_s),
        "rtt_var_ms": None if row.rtt_s is None else rounded_ms(row.rtt_var_s),
        "loss_in": round(row.loss_in, 3),
        "loss_out": round(row.loss_out, 3),
        "cost": row.cost,
    }
