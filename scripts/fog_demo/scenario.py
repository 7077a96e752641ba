"""Scenario of the demonstration: requests flow, one machine is preempted, the other is killed, no request fails.

I/O.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from fog.cli.views import event_line, machine_fields, machines_table
from fog.supervisor.core.record import Record, stage
from fog.supervisor.journal import Entry
from fog_demo.cluster import DEDICATED, Cluster, requests_in
from gdp.host.interruption import let_nothing_interrupt
from lab.command import StepDisplay
from lab.process import Event

_EVENTS: Final = 10  # number of the newest events shown
_PLAIN_EVERY_S: Final = 4.0
_LOOK_S: Final = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Request statistics of the robot's node; ``failed`` as in ``requests_in``."""

    requests: int = 0
    failed: int = 0
    median_ms: float | None = None
    p99_ms: float | None = None
    by_machine: tuple[tuple[str, int], ...] = ()

    @classmethod
    def of(cls, said: Event) -> Counts:
        """Return the counts of a line."""
        (requests, failed), won = requests_in(said), tuple(sorted(said["by_machine"].items()))
        times = {key: said[key] for key in ("median_ms", "p99_ms")}
        return cls(requests=requests, failed=failed, by_machine=won, **times)

    def line(self) -> Text:
        """Return the counts as one line."""
        median, p99 = ("-" if each is None else f"{each:.1f} ms" for each in (self.median_ms, self.p99_ms))
        failed = Text(f"{self.failed} failed", style="bold red" if self.failed else "green")
        won = ", ".join(f"{machine} {count}" for machine, count in self.by_machine)
        rest = f" of {self.requests} requests   latency {median}, p99 {p99}   first were: {won or '-'}"
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


@dataclass(frozen=True, slots=True)
class Pace:
    """Timing of the scenario; ``notice_s``: between a preemption's notice and its end."""

    rate_hz: float = 50.0
    calm_s: float = 6.0
    notice_s: float = 10.0


@dataclass(slots=True)
class Outcome:
    """Result of the scenario.

    ``steps_s``: seconds from the notice, or the kill, until its detection, and until a replacement served.
    """

    counts: Counts = field(default_factory=Counts)
    steps_s: dict[str, float] = field(default_factory=dict)
    events: list[Entry] = field(default_factory=list)

    @property
    def summary(self) -> str:
        """Return the last line of the output."""
        return f"{self.counts.failed} failed of {self.counts.requests} requests"


class _Scenario:
    """The scenario in progress."""

    def __init__(self, cluster: Cluster, pace: Pace, display: Display) -> None:
        self._cluster, self._pace, self._display = cluster, pace, display
        self.outcome = Outcome()

    def look(self) -> None:
        """Show the present state, and wait a moment."""
        news = self._cluster.events(after=self.outcome.events[-1].id if self.outcome.events else 0)
        self.outcome.events += news
        self._display.happened(news)
        self._display.show(self._cluster.machines(gone=True), self.outcome.counts)
        time.sleep(_LOOK_S)

    def play(self) -> None:
        """Preempt one machine, then kill the other one."""
        cluster, pace, display = self._cluster, self._pace, self._display
        self.look()
        cluster.call(pace.rate_hz)
        cluster.meanwhile = self._watch
        display.step(f"requests flow, {pace.rate_hz:g} a second; each goes to both machines, the first answer wins")
        self._calm()
        first, second = cluster.machines()[:2]
        display.step(f"{first.name} is preempted, with a notice of {pace.notice_s:g} s")
        self._lose(first, "preemption", {"notice"}, lambda: cluster.notice(first, pace.notice_s))
        self._calm()
        display.step(f"{second.name} is killed: SIGKILL to all of it, its link gone")
        self._lose(second, "death", {"preempted", "unreachable"}, lambda: cluster.kill(second))
        self._calm()
        display.step("that was all; the robot's node makes no further request")
        self.outcome.counts = Counts.of(cluster.end_caller())
        self.look()

    def _watch(self) -> None:
        for said in self._cluster.reports():
            self.outcome.counts = Counts.of(said)
        self.look()

    def _calm(self) -> None:
        end_s = time.monotonic() + self._pace.calm_s
        while time.monotonic() < end_s:
            self._watch()

    def _lose(self, machine: Record, what: str, signs: set[str], act: Callable[[], None]) -> None:
        """Take a machine away, and wait until a replacement serves and the machine is gone."""
        at_s = time.time()
        act()
        served = self._cluster.await_replacement(at_s)
        seen_s = self._cluster.await_event(machine.name, signs, at_s)
        self._cluster.await_whole(machine)
        self.outcome.steps_s[f"{what} to detection"] = seen_s - at_s
        self.outcome.steps_s[f"{what} to a serving replacement"] = (served.served_unix_s or at_s) - at_s


def run_scenario(launch_file: Path, pace: Pace, display: Display) -> Outcome:
    """Run the scenario on a new cluster, and take down everything."""
    display.step(f"a robot, and a site of fog; fog launch {launch_file.name} --detach")
    with Cluster([launch_file.read_text(encoding="utf-8")], 2, DEDICATED, kind="demo", note=display.step) as cluster:
        try:
            scenario = _Scenario(cluster, pace, display)
            scenario.play()
        finally:
            let_nothing_interrupt()
            display.step("giving machines back, taking the robot down")
    return scenario.outcome
