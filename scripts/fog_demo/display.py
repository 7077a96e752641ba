"""Display of the demonstration: a live table in a terminal, otherwise plain lines.

I/O; prints. The content depends only on records, events and counts.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from fog.cli.views import event_line, machine_fields, machines_table, stage
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Entry
from lab.command import StepDisplay

_EVENTS: Final = 10  # number of the newest events shown
_PLAIN_EVERY_S: Final = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Request statistics of the robot's node.

    Args:
        failed: requests without a response or with a wrong one, and requests that were not sent for lack of a server.
    """

    requests: int = 0
    answered: int = 0
    failed: int = 0
    median_ms: float | None = None
    p99_ms: float | None = None
    rate: float = 0.0
    by_machine: tuple[tuple[str, int], ...] = ()

    def line(self) -> Text:
        """Return the counts as one line."""
        median, p99 = ("-" if each is None else f"{each:.1f} ms" for each in (self.median_ms, self.p99_ms))
        failed = Text(f"{self.failed} failed", style="bold red" if self.failed else "green")
        won = ", ".join(f"{machine} {count}" for machine, count in self.by_machine)
        rest = (
            f" of {self.requests} requests   {self.rate:.0f}/s   latency {median}, p99 {p99}   first were: {won or '-'}"
        )
        return Text.assemble(failed, rest)


class Display(StepDisplay):
    """Display of steps, machines, events and counts."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, is_kept=True, plain_every_s=_PLAIN_EVERY_S)
        self._events: deque[Entry] = deque(maxlen=_EVENTS)

    def happened(self, entries: Sequence[Entry]) -> None:
        """Add new events of the journal."""
        self._events.extend(entries)
        if self._live is None:
            for each in entries:
                self._console.print(Text("         ") + event_line(each), soft_wrap=True)

    def show(self, machines: Sequence[Record], counts: Counts) -> None:
        """Show the present state; plain lines appear every few seconds."""
        there = ", ".join(f"{each.name} {each.spec.offer.region} {stage(each)}" for each in machines)
        self._show(self._page(machines, counts), counts.line() + Text(f"   machines: {there}"))

    def _page(self, machines: Sequence[Record], counts: Counts) -> RenderableType:
        now_s = time.time()
        rows = [machine_fields(each, now_s) for each in machines]
        events = [event_line(each) for each in self._events]
        return Group("", machines_table(rows, now_s), "", counts.line(), "", *events)
