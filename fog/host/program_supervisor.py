"""Restart supervisor of one program: restarts use growing pauses."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Final

from fog.host.bounded_log import BoundedLog
from fog.host.managed_process import ManagedProcess
from fog.host.status import ProgramStatus
from fog.machine import Program
from gdp.intervals import STEADY_S
from gdp.requests import Backoff

log = logging.getLogger(__name__)

RESTARTS: Final = Backoff(0.1, 10.0)
_END_PATIENCE_S: Final = 2.0


class ProgramSupervisor:
    """One program across restarts; ``changed``: called whenever ``status`` changes."""

    def __init__(self, program: Program, home: Path, changed: Callable[[], None]) -> None:
        self.program = program
        self.status = ProgramStatus()
        self.ready = asyncio.Event()  # set when it is up for the first time
        self._home = home
        self._changed = changed
        self._incarnation_id: ManagedProcess | None = None
        self._log = BoundedLog(home / "logs" / f"{program.name}.log")

    async def run(self) -> str:
        """Run the program until it ends permanently; return the reason. To stop it, cancel this, then call ``end``."""
        failures = restarts = 0
        while True:
            begun_s = asyncio.get_running_loop().time()
            how = await self._live(restarts)
            self._become(ProgramStatus(restarts=restarts))
            if not self.program.restarts:
                return f"{self.program.name} {how}"
            failures = 1 if asyncio.get_running_loop().time() - begun_s > STEADY_S else failures + 1
            pause_s = RESTARTS.pause_s(failures)
            log.warning("program ended program=%s how=%s pause_s=%.1f", self.program.name, how, pause_s)
            await asyncio.sleep(pause_s)
            restarts += 1

    def send_signal(self, number: signal.Signals) -> asyncio.Future[int] | None:
        """Send the program a signal; return a future of its exit status, or None if it does not run."""
        if self._incarnation_id is None or self._incarnation_id.ended.done():
            return None
        self._incarnation_id.signal(number)
        return self._incarnation_id.ended

    def kill(self) -> None:
        """Kill the program at once."""
        if self._incarnation_id is not None:
            self._incarnation_id.kill()

    async def end(self) -> None:
        """End the program with SIGTERM, after ``run`` was cancelled."""
        if self._incarnation_id is not None:
            await self._incarnation_id.end(_END_PATIENCE_S)
        self._log.close()
        self._become(ProgramStatus(restarts=self.status.restarts))

    async def _live(self, restarts: int) -> str:
        try:
            incarnation_id = self._incarnation_id = ManagedProcess(
                self.program, self._home, self._log, lambda: self._up(restarts)
            )
        except OSError as error:
            return f"could not be started: {error}"
        if not self.status.up:
            self._become(ProgramStatus(incarnation_id.pid, restarts=restarts))
        return f"ended with code {await asyncio.shield(incarnation_id.ended)}"

    def _up(self, restarts: int) -> None:
        self.ready.set()
        asyncio.get_running_loop().call_soon(self._tell_up, restarts)

    def _tell_up(self, restarts: int) -> None:
        if self._incarnation_id is not None and not self._incarnation_id.ended.done():
            self._become(ProgramStatus(self._incarnation_id.pid, up=True, restarts=restarts))

    def _become(self, status: ProgramStatus) -> None:
        if status != self.status:
            self.status = status
            self._changed()
