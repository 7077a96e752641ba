"""Links of a node for ``gdp status`` and metrics: one row for each neighbour that is up.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Mapping

from gdp.control.neighbour_discovery import HelloProtocol
from gdp.ports.plane import Port
from gdp.sansio import Timestamps
from gdp.telemetry.sources import LinkRow

__all__ = ["LinkRows", "link_status"]


class LinkRows:
    """The links of one node as of the last ``refresh``, which the node's own thread calls.

    Attributes:
        rows: sorted by port and neighbour.
    """

    def __init__(self, hello_protocol: HelloProtocol, ports: Mapping[int, Port]) -> None:
        self._hello_protocol = hello_protocol
        self._ports = ports
        self.rows: list[LinkRow] = []

    def refresh(self, _now: Timestamps) -> None:
        """Read the measurements of all neighbours that are up."""
        rows = []
        for neighbour in self._hello_protocol.neighbours.all_up():
            quality = self._hello_protocol.ports[neighbour.port].quality_of(neighbour.name)
            port = self._ports.get(neighbour.port)
            rows.append(
                LinkRow(
                    port=str(neighbour.port) if port is None else port.ifname,
                    neighbour=neighbour.name.short,
                    rtt_s=quality.rtt.srtt_s,
                    rtt_var_s=quality.rtt.rttvar_s,
                    loss_in=quality.loss_in,
                    loss_out=quality.loss_out,
                    cost=neighbour.cost,
                )
            )
        self.rows = sorted(rows, key=lambda row: (row.port, row.neighbour))


def link_status(row: LinkRow) -> dict[str, object]:
    """Return the JSON fields of a link; ``rtt_ms`` is None before the first measurement."""
    is_measured = row.rtt_s is not None
    return {
        "port": row.port,
        "neighbour": row.neighbour,
        "rtt_ms": round(1_000 * (row.rtt_s or 0.0), 3) if is_measured else None,
        "rtt_var_ms": round(1_000 * row.rtt_var_s, 3) if is_measured else None,
        "loss_in": round(row.loss_in, 3),
        "loss_out": round(row.loss_out, 3),
        "cost": row.cost,
    }
