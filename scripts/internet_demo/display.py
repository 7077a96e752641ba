"""Display of the demonstration: a live table in a terminal, otherwise plain lines.

I/O; prints.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from internet_demo.stage import Link, Machine
from internet_demo.traffic import Traffic

__all__ = ["Display"]

_PLAIN_EVERY_S: Final = 2.5
_WAYS: Final = (("direct", True), ("border", False))


class Display:
    """Display of steps, machines and counts; a context manager."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._begun_s = self._reported_s = time.monotonic()
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None

    def __enter__(self) -> Display:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def step(self, text: str) -> None:
        """Show the present step."""
        elapsed_s = time.monotonic() - self._begun_s
        line = Text.assemble((f"{elapsed_s:5.1f} s  ", "dim"), (text, "bold"))
        self._console.print(line, highlight=False, soft_wrap=True)

    def show(self, machines: Iterable[Machine], links: Mapping[str, Sequence[Link]], traffic: Traffic) -> None:
        """Show the present state; plain lines appear every few seconds."""
        counts = _counts(traffic)
        if self._live is not None:
            if not self._live.is_started:
                self._live.start()
            self._live.update(_page(machines, links, counts), refresh=True)
        elif time.monotonic() - self._reported_s >= _PLAIN_EVERY_S:
            self._reported_s = time.monotonic()
            self._console.print(Text(f"         {counts}; {_ways(links.get('robot', ()))}"), soft_wrap=True)


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
            state = " (cut)" if site.fault.is_cut else ""
            table.add_row(first, device, f"{site.label}, {site.access.value}{state}", address, public, tunnels)
            tunnels = ""
    return Group(table, Text(counts))
