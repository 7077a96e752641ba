"""Display of the demonstration: a live table in a terminal, otherwise plain lines.

I/O; prints.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from internet_demo.stage import Link, Machine
from internet_demo.traffic import Traffic
from lab.command import StepDisplay

_PLAIN_EVERY_S: Final = 2.5
_WAYS: Final = (("direct", True), ("border", False))


class Display(StepDisplay):
    """Display of steps, machines and counts."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, is_kept=False, plain_every_s=_PLAIN_EVERY_S)

    def show(self, machines: Iterable[Machine], links: Mapping[str, Sequence[Link]], traffic: Traffic) -> None:
        """Show the present state; plain lines appear every few seconds."""
        counts = _counts(traffic)
        self._show(_page(machines, links, counts), Text(f"{counts}; {_ways(links.get('robot', ()))}"))


def _counts(traffic: Traffic) -> str:
    got = ", ".join(f"{each.label} {len(each.counts)}" for each in traffic.readers.values())
    calls = traffic.calls
    return f"{traffic.camera.sent} images ({got}), {calls.answered} of {calls.begun} calls"


def _ways(tunnels: Sequence[Link]) -> str:
    """Return which peers are joined directly and which are borders, each once."""
    peers = {way: sorted({each.peer for each in tunnels if each.is_direct is is_direct}) for way, is_direct in _WAYS}
    return "; ".join(f"{way} {', '.join(found)}" for way, found in peers.items() if found) or "no tunnel"


def _page(machines: Iterable[Machine], links: Mapping[str, Sequence[Link]], counts: str) -> RenderableType:
    table = Table("machine", "device", "network", "address", "public address", "tunnels")
    for machine in machines:
        tunnels = "\n".join(
            f"{each.peer} {'direct' if each.is_direct else 'border'} {each.endpoint}"
            for each in links.get(machine.label, ())
        )
        for number, device in enumerate(machine.host.devices):
            site, lease = machine.host.site(device), machine.host.lease(device)
            address = (lease.address or lease.address6).partition("/")[0]
            first = machine.label if number == 0 else ""
            public = site.address or address
            state = " (cut)" if site.is_cut else ""
            table.add_row(first, device, f"{site.label}, {site.access.value}{state}", address, public, tunnels)
            tunnels = ""
    return Group(table, Text(counts))
