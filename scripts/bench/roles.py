"""Processes of the forwarding bench, each in a namespace of its own: ``switch`` and ``end``.

LabProcess by ``chains.py``. Each reads commands as JSON lines on stdin and answers every one with a JSON line.
"""

from __future__ import annotations

import gc
import json
import os
import sys
from contextlib import closing
from typing import Any, Final

from ends import answer_pings, count_frames, ping, send
from frames import SINK, SOURCE
from peers.jsonl import order_waits, read_order, say

from gdp.errors import LocalError
from gdp.ports.netdev import NetdevPlane
from gdp.switch.table import Table

_ENTRIES_MAX: Final = 1_024
_LEASE_S: Final = 1e9


def make_plane(kind: str, ifnames: list[str], table: Table) -> NetdevPlane:
    """Return a plane by its name in the benches.

    Raises:
        LocalError: it is not available here; the text gives the reason.
    """
    if kind == "scapy":
        from gdp.ports.scapy_plane import ScapyPlane

        return ScapyPlane(ifnames, table)
    if kind == "raw":
        from gdp.ports.raw import RawPlane

        return RawPlane(ifnames, table)
    from gdp.ports.kernel.plane import KernelPlane

    return KernelPlane(ifnames, table, entries_max=_ENTRIES_MAX, peer=kind == "kernel")


def switch(plane: str, ways: dict[str, str], **_: Any) -> None:
    """Forward by a static table until stdin closes.

    Args:
        plane: which one.
        ways: the devices towards the source ("left") and the sink ("right"), each "device neighbour's-MAC" in hex.
    """
    left, right = (ways[side].split() for side in ("left", "right"))
    table = Table(_ENTRIES_MAX)
    try:
        made = make_plane(plane, [left[0], right[0]], table)
    except LocalError as error:
        say(refused_because=str(error))
        return
    own = {port.ifname: port for port in made.ports.values()}
    for name, (ifname, mac) in ((SINK, right), (SOURCE, left)):
        table.install(name, ((own[ifname].index, bytes.fromhex(mac) + own[ifname].mac),), _LEASE_S)
    made.watch(sys.stdin, sys.exit)
    gc.collect()
    gc.freeze()
    say(event="ready")
    with closing(made):
        while True:
            made.poll(None)


def end(ifname: str, **_: Any) -> None:
    """Send, count, ping or answer on one device, as commanded."""
    say(event="ready")
    gc.freeze()
    gc.disable()
    while True:
        order = read_order()
        ethertype = order.get("ethertype", 0)
        frame = bytes.fromhex(order.get("frame", ""))
        if order["do"] == "send":
            say(**send(ifname, frame, order["rate"], order["seconds"])._asdict())
        elif order["do"] == "count":
            say(**count_frames(ifname, ethertype, ready, expected)._asdict())
        elif order["do"] == "ping":
            say(rtt_us=ping(ifname, ethertype, frame, order["pings"], poll=order["poll"]))
        elif order["do"] == "answer":
            say(answered=answer_pings(ifname, ethertype, frame, order["pings"], ready, poll=order["poll"]))


def expected() -> int | None:
    """Return how many frames the source has sent, once the bench has reported it."""
    return int(read_order()["expected"]) if order_waits() else None


def ready() -> None:
    """Report that the process is ready."""
    say(event="ready")


if __name__ == "__main__":
    settings = json.loads(sys.argv[1])
    if (cpu := settings.pop("cpu")) is not None:
        os.sched_setaffinity(0, {cpu})
    if settings.pop("role") == "switch":
        switch(**settings)
    else:
        end(**settings)
