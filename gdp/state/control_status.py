"""Status of a node for ``gdp status``: identity, uptime and counters.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from gdp.crypto.identity import Identity
from gdp.telemetry.sources import Sources

__all__ = ["node_status"]

_ROWS: Final = ("entries", "latency", "links", "ports", "topics", "health")  # no counters


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
            counters["drops"] = sum(sum(part()) for part in source)
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
