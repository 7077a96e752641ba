"""Fields of one flow of a bridge for the snapshot of its proxy.

Sans-I/O.
"""

from __future__ import annotations

from gdp.state.snapshot import short_id
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.imported_service import ImportedService

__all__ = ["flow_fields"]

_SERVERS_MAX = 64


def flow_fields(spec: FlowSpec, flow: object) -> dict[str, object]:
    """Return name, type and direction; of an imported service also its servers with their first answers.

    A server that left keeps its answers and has ``is_there`` false.
    """
    fields: dict[str, object] = {
        "name": short_id(spec.name),
        "local": spec.local,
        "type": spec.type_name,
        "kind": spec.rule.kind,
        "is_exposed": spec.is_exposed,
    }
    if isinstance(flow, ImportedService):
        there = set(flow.servers)
        every = sorted(there | flow.first_answers.keys())[:_SERVERS_MAX]
        fields["servers"] = [
            {"id": short_id(server), "is_there": server in there, "first": flow.first_answers[server]}
            for server in every
        ]
    return fields
