"""Machine agent: the programs of a machine, its status and its shutdown.

I/O.
::

    BOOTING -- all programs are up --> RUNNING -- notice, drain --> LEAVING -- its end, or the notice's moment --> gone
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from fog.host.bundle import BOOT_FILE, read_programs
from fog.host.preemption_notice import read_notice
from fog.host.program_supervisor import ProgramSupervisor
from fog.host.status import Status
from fog.machine import MachineState
from gdp.errors import LocalError
from gdp.intervals import DRAIN_S

log = logging.getLogger(__name__)

DRAINS: Final = "proxy"  # the program that tracks calls in progress
_SIGNALS: Final = {signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2}


class MachineAgent:
    """Agent of the machine whose folder is ``home``.

    SIGTERM and SIGINT end it. SIGUSR1 drains it: ``proxy`` receives SIGUSR1 too and may finish its calls, then all
    programs end. SIGUSR2 means that the folder contains a notice; at its time all programs are killed, as the provider
    would do. The signals may be blocked when the agent starts.

    Raises:
        LocalError: ``boot.json`` is missing or invalid.
    """

    def __init__(self, home: Path) -> None:
        self._home = home
        try:
            programs = read_programs((home / BOOT_FILE).read_bytes())
        except OSError as error:
            raise LocalError(f"{home / BOOT_FILE}: {error.strerror}") from error
        (home / "logs").mkdir(mode=0o700, exist_ok=True)
        self._state = MachineState.BOOTING
        self._reason = ""
        self._supervisors: tuple[ProgramSupervisor, ...] = ()
        self._programs = programs
        self._tasks: list[asyncio.Task[str]] = []

    async def run(self) -> str:
        """Run the machine until its end; return the reason."""
        self._supervisors = tuple(ProgramSupervisor(program, self._home, self._tell) for program in self._programs)
        end, drain = asyncio.Event(), asyncio.Event()
        self._listen(end, drain)
        self._take_notice()
        self._tell()
        ended, drained = asyncio.ensure_future(end.wait()), asyncio.ensure_future(drain.wait())
        fallen = asyncio.ensure_future(self._run_programs())
        try:
            await asyncio.wait([ended, drained, fallen], return_when=asyncio.FIRST_COMPLETED)
            if fallen.done():
                self._leave(fallen.result())
            elif ended.done():
                self._leave("was asked to end")
            else:
                self._leave("drained")
                await self._drain(end)
        finally:
            for task in (ended, drained, fallen, *self._tasks):
                task.cancel()
            for supervisor in reversed(self._supervisors):
                await supervisor.end()
            self._become(MachineState.GONE, self._reason)
        return self._reason

    def _listen(self, end: asyncio.Event, drain: asyncio.Event) -> None:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, end.set)
        loop.add_signal_handler(signal.SIGUSR1, drain.set)
        loop.add_signal_handler(signal.SIGUSR2, self._take_notice)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)

    async def _run_programs(self) -> str:
        """Start all programs, wait until all are up, then wait until one ends permanently."""
        self._tasks = [asyncio.ensure_future(supervisor.run()) for supervisor in self._supervisors]
        up = asyncio.create_task(self._all_up())
        await asyncio.wait([up, *self._tasks], return_when=asyncio.FIRST_COMPLETED)
        if up.done():
            if self._state is MachineState.BOOTING:
                self._become(MachineState.RUNNING, "")
        else:
            up.cancel()
        if not self._tasks:
            await asyncio.get_running_loop().create_future()
        done, _ = await asyncio.wait(self._tasks, return_when=asyncio.FIRST_COMPLETED)
        return done.pop().result()

    async def _all_up(self) -> None:
        for supervisor in self._supervisors:
            await supervisor.ready.wait()

    async def _drain(self, end: asyncio.Event) -> None:
        """Let calls in progress finish; no program is restarted."""
        for task in self._tasks:
            task.cancel()
        for supervisor in self._supervisors:
            if supervisor.program.name == DRAINS and (answered := supervisor.send_signal(signal.SIGUSR1)) is not None:
                answered.add_done_callback(lambda _: end.set())
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(end.wait(), DRAIN_S)

    def _take_notice(self) -> None:
        leaves_at_unix_s = read_notice(self._home)
        if leaves_at_unix_s is not None:
            self._become(MachineState.LEAVING, "preempted")
            asyncio.get_running_loop().call_later(max(leaves_at_unix_s - time.time(), 0.0), self._die)

    def _die(self) -> None:
        """End like a machine that is switched off."""
        for supervisor in self._supervisors:
            supervisor.kill()
        os.kill(os.getpid(), signal.SIGKILL)

    def _leave(self, reason: str) -> None:
        log.info("machine leaves reason=%s", reason)
        self._become(MachineState.LEAVING, self._reason or reason)

    def _become(self, state: MachineState, reason: str) -> None:
        self._state, self._reason = state, reason
        self._tell()

    def _tell(self) -> None:
        programs = {supervisor.program.name: supervisor.status for supervisor in self._supervisors}
        Status(self._state, time.time(), programs, self._reason).write(self._home)
