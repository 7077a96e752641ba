"""Scenario of the demonstration: requests flow, one machine is preempted, the other is killed, no request fails.

I/O.
"""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from fog.cli.views import event_line, machine_fields, machines_table, stage
from fog.providers.local.fault_injection import kill, notice
from fog.site import Site, open_site
from fog.supervisor.core.record import Record
from fog.supervisor.infrastructure import local_provider
from fog.supervisor.journal import Entry, Journal
from fog_demo.environment import Environment
from gdp.errors import LocalError
from lab.children import Child, cancel
from lab.command import StepDisplay
from lab.events import Event

_EVENTS: Final = 10  # number of the newest events shown
_PLAIN_EVERY_S: Final = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Request statistics of the robot's node.

    ``failed``: requests without a response or with a wrong one, and requests that were not sent for lack of a server.
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


_LOOK_S: Final = 0.2
_BOOT_S: Final = 90.0
_END_S: Final = 20.0  # longer than the caller's timeout of a response
_PATIENCE_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class Pace:
    """Timing of the scenario; ``notice_s``: between a preemption's notice and its end."""

    rate_hz: float = 50.0
    calm_s: float = 6.0
    notice_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the scenario.

    ``steps_s``: seconds from the notice, or the kill, until its detection, and until a replacement served.
    ``complaints``: lines of the robot's node about failed requests.
    """

    counts: Counts
    steps_s: dict[str, float]
    events: list[Entry] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    @property
    def summary(self) -> str:
        """Return the last line of the output."""
        return f"{self.counts.failed} failed of {self.counts.requests} requests"


class _Looking:
    """Poller of the journal and the caller's lines, which displays both until it is cancelled."""

    def __init__(self, journal: Journal, display: Display) -> None:
        self._journal = journal
        self._display = display
        self.counts = Counts()
        self.events: list[Entry] = []
        self._reported_s = 0.0

    async def run(self) -> None:
        """Poll repeatedly."""
        while True:
            self.look()
            await asyncio.sleep(_LOOK_S)

    async def hear(self, caller: Child) -> None:
        """Read the caller's lines to the last one."""
        async for event in caller.events():
            self._take(event)

    def machines(self) -> list[Record]:
        """Return all machines, including those that are gone."""
        return [each for cluster in self._journal.clusters() for each in self._journal.machines(cluster.plan.name)]

    def look(self) -> None:
        """Poll once."""
        news = self._journal.events(after=self.events[-1].id if self.events else 0)
        self.events += news
        self._display.happened(news)
        self._display.show(self.machines(), self.counts)

    def first_event(self, machine: str, what: set[str]) -> Entry | None:
        """Return the first event of a machine that is one of these."""
        return next((each for each in self.events if each.machine == machine and each.what in what), None)

    def _take(self, event: Event) -> None:
        now_s, before, answered = time.monotonic(), self.counts, event.count("answered")
        rate = (answered - before.answered) / (now_s - self._reported_s) if self._reported_s else 0.0
        self._reported_s = now_s
        left = event.count("under_way") if event.fields.get("done") else 0
        won = sorted((name, int(str(count))) for name, count in event.part("by_machine").fields.items())
        self.counts = Counts(
            requests=event.count("calls") + event.count("unserved"),
            answered=answered,
            failed=event.count("failed") + event.count("wrong") + event.count("unserved") + left,
            median_ms=event.number_or_none("median_ms"),
            p99_ms=event.number_or_none("p99_ms"),
            rate=rate,
            by_machine=tuple(won),
        )


async def run_scenario(environment: Environment, launch_file: Path, pace: Pace, display: Display) -> Outcome:
    """Run the scenario on a new environment."""
    display.step("a ring of five switches, the RIB at nuc3, the robot at nuc1, the site of fog beyond nuc5")
    plane = await environment.stand_up()
    site = open_site(environment.site_file, environment.state)
    with closing(Journal(site.journal)) as journal:
        looking = _Looking(journal, display)
        shown = asyncio.ensure_future(looking.run())
        try:
            display.step(f"data plane {plane}; fog launch {launch_file.name} --detach")
            await environment.fog("launch", str(launch_file), "--detach", patience_s=_BOOT_S)
            caller = environment.start_caller(pace.rate_hz)
            heard = asyncio.ensure_future(looking.hear(caller))
            try:
                steps_s = await environment.children.guarded(_befall(site, looking, pace, display))
                display.step("that was all; the robot's node makes no further request")
                caller.send(signal.SIGUSR1)
                await asyncio.wait_for(heard, _END_S)
            finally:
                await cancel(heard)
            looking.look()
            complaints = caller.log.read_text(encoding="utf-8", errors="replace").splitlines()
        finally:
            await cancel(shown)
        return Outcome(looking.counts, steps_s, looking.events, complaints)


async def _befall(site: Site, looking: _Looking, pace: Pace, display: Display) -> dict[str, float]:
    """Preempt one machine, then kill the other; return the durations in seconds."""
    runs = local_provider(site).runs
    steps_s: dict[str, float] = {}
    await _until(lambda: looking.counts.answered > 0, "the first answer")
    display.step(f"requests flow, {pace.rate_hz:g} a second; each goes to both machines, the first answer wins")
    await asyncio.sleep(pace.calm_s)
    first, second = looking.machines()[:2]

    display.step(f"{first.name} is preempted, with a notice of {pace.notice_s:g} s")
    at_s = time.time()
    notice(runs, first.id, pace.notice_s)
    steps_s |= await _replaced(looking, first, {"notice"}, at_s, "preemption")
    await _until(lambda: _is_gone(looking, first), f"the end of {first.name}")
    await asyncio.sleep(pace.calm_s)

    display.step(f"{second.name} is killed: SIGKILL to all of it, its link gone")
    at_s = time.time()
    kill(runs, second.id)
    steps_s |= await _replaced(looking, second, {"preempted", "unreachable"}, at_s, "death")
    await asyncio.sleep(pace.calm_s)
    return steps_s


async def _replaced(looking: _Looking, machine: Record, signs: set[str], at_s: float, what: str) -> dict[str, float]:
    """Wait until a machine that was requested after this time serves."""

    def serving() -> Record | None:
        later = (each for each in looking.machines() if each.asked_unix_s >= at_s and each.is_serving)
        return next(later, None)

    await _until(lambda: serving() is not None, f"a replacement of {machine.name}")
    seen, served = looking.first_event(machine.name, signs), serving()
    found = {}
    if seen is not None:
        found[f"{what} to detection"] = seen.unix_s - at_s
    if served is not None and served.served_unix_s is not None:
        found[f"{what} to a serving replacement"] = served.served_unix_s - at_s
    return found


def _is_gone(looking: _Looking, machine: Record) -> bool:
    return any(each.name == machine.name and each.is_gone for each in looking.machines())


async def _until(is_met: Callable[[], bool], what: str) -> None:
    """Poll until a condition without notification holds."""
    end_s = time.monotonic() + _PATIENCE_S
    while not is_met():
        if time.monotonic() > end_s:
            raise LocalError(f"waited {_PATIENCE_S:g} s for {what}; load of this machine: {os.getloadavg()[0]:.1f}")
        await asyncio.sleep(_LOOK_S / 4)
