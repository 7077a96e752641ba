"""Processes of the forwarding and scale benches, each in a namespace of its own: ``switch`` and ``end``.

Started by ``chains.py``. Each reads commands as JSON lines on stdin and answers every one with a JSON line.
"""

from __future__ import annotations

import gc
import json
import os
import sys
from contextlib import ExitStack
from typing import Any

from ends import answer_pings, count_frames, ping, send, spread_frames
from frames import NAME_AT, SINK, SOURCE, spread_names
from peers.jsonl import order_waits, read_order, say
from table_fill import ENTRY_LEASE_S, fill

from gdp.errors import LocalError
from gdp.ports.netdev import NetdevPlane
from gdp.switch.table import Table


def make_plane(kind: str, ifnames: list[str], table: Table, entries_max: int) -> NetdevPlane:
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

    return KernelPlane(ifnames, table, entries_max=entries_max, peer=kind == "kernel")


def switch(plane: str, ways: dict[str, str], names: int = 0, **_: Any) -> None:
    """Forward by a static table until stdin closes.

    Args:
        plane: which one.
        ways: the devices towards the source ("left") and the sink ("right"), each "device neighbour's-MAC" in hex.
        names: entries in addition to those two; all lead to the right.
    """
    left, right = (ways[side].split() for side in ("left", "right"))
    entries_max = max(names + 2, 1_024)
    table = Table(entries_max)
    try:
        made = make_plane(plane, [left[0], right[0]], table, entries_max)
    except LocalError as error:
        say(refused_because=str(error))
        return
    own = {port.ifname: port for port in made.ports.values()}
    hops = {
        name: ((own[ifname].index, bytes.fromhex(mac) + own[ifname].mac),)
        for name, (ifname, mac) in ((SINK, right), (SOURCE, left))
    }
    for name, hop in hops.items():
        table.install(name, hop, ENTRY_LEASE_S)

    def asked() -> None:
        with ExitStack() as undo:
            undo.callback(made.close)
            read_order()
            undo.pop_all()
        say(**fill(table, names, hops[SINK]))

    made.watch(sys.stdin, asked)
    gc.collect()
    gc.freeze()
    say(event="ready")
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
            names = spread_names(order["names"], order["of"]) if order["names"] else []
            frames = spread_frames(frame, NAME_AT, names) if names else [frame]
            say(**send(ifname, frames, order["rate"], order["seconds"])._asdict())
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
