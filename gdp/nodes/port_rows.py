"""Ports of a node for metrics: state, MTU, and what the kernel counted at each device.

I/O: one netlink socket for each call, which may come from any thread.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from contextlib import closing
from typing import Final

from gdp.errors import LocalError
from gdp.ports.netlink import LinkAttribute, NetlinkSocket
from gdp.ports.plane import Port
from gdp.telemetry.sources import DeviceCounts, PortRow

__all__ = ["port_rows"]

_STATS: Final = struct.Struct("=8Q")  # the first of struct rtnl_link_stats64, linux/if_link.h


def port_rows(ports: Mapping[int, Port]) -> list[PortRow]:
    """Return one row for each port, by device name; a port whose device is absent has no counts."""
    rows = []
    with closing(NetlinkSocket()) as question:
        for port in list(ports.values()):
            rows.append(PortRow(port.ifname, is_up=port.up, mtu=port.mtu, counts=_counts(question, port.ifname)))
    return sorted(rows, key=lambda row: row.port)


def _counts(question: NetlinkSocket, ifname: str) -> DeviceCounts | None:
    try:
        device = question.link_named(ifname)
    except LocalError:
        return None  # the device goes just now
    stats = b"" if device is None else device.attributes.get(LinkAttribute.STATS64, b"")
    return DeviceCounts(*_STATS.unpack_from(stats)) if len(stats) >= _STATS.size else None
