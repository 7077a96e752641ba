"""Injection of the faults of a run: cuts links, moves cables, kills and restarts processes, each at its second.

I/O.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol

from lab.children import cancel
from ring.faults import Cut, Fault, Kill, Roam
from ring.progress import ProgressReporter


class Injector(Protocol):
    """Fault operations of a run's overlay."""

    async def cut(self, cut: Cut) -> None:
        """Take a link down."""

    async def heal(self, cut: Cut) -> None:
        """Bring a link up."""

    async def kill(self, kill: Kill) -> None:
        """Kill a process."""

    async def restart(self, kill: Kill) -> None:
        """Restart a process; return when it is ready."""

    async def roam(self, roam: Roam) -> None:
        """Move a proxy's cable to another switch."""


class Injection:
    """The faults of one run. Their seconds count from the creation of this object."""

    def __init__(self, injector: Injector, faults: Sequence[Fault], reporter: ProgressReporter) -> None:
        self._injector = injector
        self._reporter = reporter
        self._begun: set[Fault] = set()
        self._tasks = {fault: asyncio.ensure_future(self._inject(fault)) for fault in faults}

    async def stop(self) -> None:
        """Stop the injection."""
        await cancel(*self._tasks.values())

    def complaints(self) -> list[str]:
        """Return, after the stop, the faults that came too late."""
        for task in self._tasks.values():
            if not task.cancelled():
                task.result()
        return [f"{fault} came too late: the traffic was over" for fault in self._tasks if fault not in self._begun]

    async def _inject(self, fault: Fault) -> None:
        injector = self._injector
        if isinstance(fault, Cut):
            link = f"{fault.a}-{fault.b}"
            await self._at(fault.after_s, lambda: injector.cut(fault), f"cut {link}")
            self._begun.add(fault)
            await self._at(fault.until_s, lambda: injector.heal(fault), f"{link} is back", fault.after_s)
        elif isinstance(fault, Kill):
            process = f"{fault.role} of {fault.of}" if fault.role == "rib" else f"{fault.role} {fault.of}"
            await self._at(fault.after_s, lambda: injector.kill(fault), f"killed {process}")
            self._begun.add(fault)
            await self._at(fault.until_s, lambda: injector.restart(fault), f"{process} is back", fault.after_s)
        else:
            await self._at(fault.after_s, lambda: injector.roam(fault), f"{fault.who} moved to {fault.to}")
            self._begun.add(fault)

    async def _at(
        self, at_s: float | None, act: Callable[[], Awaitable[None]], done: str, passed_s: float = 0.0
    ) -> None:
        if at_s is not None:
            await asyncio.sleep(at_s - passed_s)
            await act()
            self._reporter.step(done)
