"""Tables that every node keeps: its neighbours, its links and what it dropped.

Sans-I/O. Each row is a mapping with the same keys, for ``gdp show`` and JSON. Durations are in milliseconds or seconds,
as the key says.
"""

from __future__ import annotations

from gdp.burst import VARIANT
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row, TableSource
from gdp.state.node_state import NodeState
from gdp.telemetry.sources import NeighbourRow


def common_tables(state: NodeState) -> dict[str, TableSource]:
    """Return the sources of the tables ``neighbors``, ``links`` and ``drops``."""
    return {
        "neighbors": lambda _now: [_neighbour(state, row) for row in state.neighbours()],
        "links": lambda _now: _links(state),
        "drops": lambda _now: _drops(state),
    }


def rounded_ms(duration_s: float | None) -> float | None:
    """Return seconds as milliseconds for JSON; None: not measured."""
    return None if duration_s is None else round(1e3 * duration_s, 3)


def seconds_left(end_s: float | None, now: Timestamps) -> float | None:
    """Return the seconds until a moment of the monotonic clock, not below zero."""
    return None if end_s is None else round(max(end_s - now.mono_s, 0.0), 1)


def _neighbour(state: NodeState, row: NeighbourRow) -> Row:
    return {
        "port": row.port,
        "neighbor": row.label,
        "role": row.role,
        "domain": state.domain_label(row.domain),
        "state": row.state,
        "rtt_ms": rounded_ms(row.rtt_s),
        "loss_in": round(row.loss_in, 3),
        "loss_out": round(row.loss_out, 3),
        "cost": row.cost,
        "mtu": row.mtu,
        "mac": row.mac.hex(":"),
        "name": row.name,
    }


def _links(state: NodeState) -> list[Row]:
    costs: dict[str, list[int]] = {}
    for row in state.neighbours(is_up=True):
        costs.setdefault(row.port, []).append(row.cost)
    hello_ports = state.hello_protocol.ports
    return [
        {
            "port": port.ifname,
            "up": port.up,
            "mtu": port.mtu,
            "usable_mtu": hello_ports[index].mtu if index in hello_ports else None,
            "cost": min(costs.get(port.ifname, ()), default=None),
            "neighbors": len(costs.get(port.ifname, ())),
            "mac": port.mac.hex(":"),
            "burst_core": VARIANT,
        }
        for index, port in sorted(state.plane.ports.items())
    ]


def _drops(state: NodeState) -> list[Row]:
    counts = sorted(state.drops().items(), key=lambda item: (-item[1], item[0]))
    return [{"reason": reason.label, "frames": count} for reason, count in counts]
