"""Processes of the forwarding and scale benches, each in a namespace of its own: ``switch`` and ``end``.

Started by ``worker.py``. Each reads commands as JSON lines on stdin and answers every one with a JSON line.

"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from typing import Any

from ends import answer_pings, count_frames, ping, send, spread_frames
from frames import NAME_AT, SINK, SOURCE, spread_names
from table_fill import ENTRY_LEASE_S, fill, resident_bytes
from worker import answer, command, command_waits, integer

from gdp.errors import DropReason, LocalError
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
        answer({"refused_because": str(error)})
        return
    own = {port.ifname: port for port in made.ports.values()}
    hops = {
        name: ((own[ifname].index, bytes.fromhex(mac) + own[ifname].mac),)
        for name, (ifname, mac) in ((SINK, right), (SOURCE, left))
    }
    for name, hop in hops.items():
        table.install(name, hop, ENTRY_LEASE_S)

    def asked() -> None:
        if not (line := sys.stdin.readline()):
            made.close()
            sys.exit(0)
        if json.loads(line).get("do") == "fill":
            answer(fill(table, names, hops[SINK]))
            return
        drops = made.counters.drops
        answer(
            {
                "drops": {reason.name: lost for reason in DropReason if (lost := drops[reason])},
                "cpu_s": time.process_time(),
                "rss_mib": resident_bytes() / (1 << 20),
            }
        )

    made.watch(sys.stdin, asked)
    gc.collect()
    gc.freeze()
    answer({"event": "ready"})
    while True:
        made.poll(None)


def end(ifname: str, **_: Any) -> None:
    """Send, count, ping or answer on one device, as commanded."""
    answer({"event": "ready"})
    gc.freeze()
    gc.disable()
    while True:
        order: dict[str, Any] = command()
        ethertype = order.get("ethertype", 0)
        frame = bytes.fromhex(order.get("frame", ""))
        if order["do"] == "send":
            names = spread_names(order["names"], order["of"]) if order["names"] else []
            frames = spread_frames(frame, NAME_AT, names) if names else [frame]
            answer(send(ifname, frames, order["rate"], order["seconds"])._asdict())
        elif order["do"] == "count":
            seen = count_frames(ifname, ethertype, ready, expected)
            answer(seen._asdict())
        elif order["do"] == "ping":
            answer({"rtt_us": ping(ifname, ethertype, frame, order["pings"], poll=order["poll"])})
        elif order["do"] == "answer":
            answer({"answered": answer_pings(ifname, ethertype, frame, order["pings"], ready, poll=order["poll"])})


def expected() -> int | None:
    """Return how many frames the source has sent, once the bench has reported it."""
    return integer(command()["expected"]) if command_waits() else None


def ready() -> None:
    """Report that the process is ready."""
    answer({"event": "ready"})


if __name__ == "__main__":
    settings = json.loads(sys.argv[1])
    if (cpu := settings.pop("cpu")) is not None:
        os.sched_setaffinity(0, {cpu})
    if settings.pop("role") == "switch":
        switch(**settings)
    else:
        end(**settings)
