"""Tables that every node keeps: its neighbours, its links and what it dropped.

Sans-I/O. Each row is a mapping with the same keys, for ``gdp show`` and JSON. Durations are in milliseconds or seconds,
as the key says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.errors import DropReason
from gdp.names import Name
from gdp.ports.plane import Plane
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row, TableSource
from gdp.trust.domain import Policy

__all__ = ["common_tables", "domain_label", "seconds_left"]


def common_tables(
    hello_protocol: HelloProtocol, plane: Plane, policy: Policy, drops: Iterable[Callable[[], Sequence[int]]]
) -> dict[str, TableSource]:
    """Return the sources of the tables ``neighbors``, ``links`` and ``drops``.

    Args:
        drops: each returns counts by ``DropReason``.
    """
    parts = tuple(drops)
    return {
        "neighbors": lambda _now: _neighbours(hello_protocol, plane, policy),
        "links": lambda _now: _links(hello_protocol, plane),
        "drops": lambda _now: _drops([part() for part in parts]),
    }


def domain_label(policy: Policy, domain: Name) -> str:
    """Return the label of a trusted domain; of another one, its short name."""
    root = policy.roots.get(domain)
    return domain.short if root is None else root.label


def seconds_left(end_s: float | None, now: Timestamps) -> float | None:
    """Return the seconds until a moment of the monotonic clock, not below zero."""
    return None if end_s is None else round(max(end_s - now.mono_s, 0.0), 1)


def _neighbours(hello_protocol: HelloProtocol, plane: Plane, policy: Policy) -> list[Row]:
    return [
        _neighbour(each, hello_protocol, plane, policy)
        for index in sorted(hello_protocol.ports)
        for _, each in sorted(hello_protocol.ports[index].neighbours.items())
    ]


def _neighbour(neighbour: Neighbour, hello_protocol: HelloProtocol, plane: Plane, policy: Policy) -> Row:
    quality = hello_protocol.ports[neighbour.port].quality_of(neighbour.name)
    rtt_s = quality.rtt.srtt_s
    return {
        "port": _ifname(plane, neighbour.port),
        "neighbor": "" if neighbour.member is None else neighbour.member.label,
        "role": neighbour.role.value,
        "domain": domain_label(policy, neighbour.domain),
        "state": neighbour.state.name.lower(),
        "rtt_ms": None if rtt_s is None else round(1e3 * rtt_s, 3),
        "loss_in": round(quality.loss_in, 3),
        "loss_out": round(quality.loss_out, 3),
        "cost": neighbour.cost,
        "mtu": neighbour.mtu,
        "mac": neighbour.mac.hex(":"),
        "name": neighbour.name,
    }


def _links(hello_protocol: HelloProtocol, plane: Plane) -> list[Row]:
    rows: list[Row] = []
    for index, port in sorted(plane.ports.items()):
        hello_port = hello_protocol.ports.get(index)
        up = [] if hello_port is None else [n for n in hello_port.neighbours.values() if n.state is NeighbourState.UP]
        rows.append(
            {
                "port": port.ifname,
                "up": port.up,
                "mtu": port.mtu,
                "usable_mtu": None if hello_port is None else hello_port.mtu,
                "cost": min((each.cost for each in up), default=None),
                "neighbors": len(up),
                "mac": port.mac.hex(":"),
            }
        )
    return rows


def _drops(parts: Iterable[Sequence[int]]) -> list[Row]:
    counts = dict.fromkeys(DropReason, 0)
    for part in parts:
        for reason in DropReason:
            counts[reason] += part[reason]
    found: Mapping[DropReason, int] = {reason: count for reason, count in counts.items() if count}
    return [
        {"reason": reason.label, "frames": count} for reason, count in sorted(found.items(), key=lambda item: -item[1])
    ]


def _ifname(plane: Plane, index: int) -> str:
    port = plane.ports.get(index)
    return str(index) if port is None else port.ifname
