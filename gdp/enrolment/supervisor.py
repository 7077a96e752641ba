"""Foreground supervisor of a machine's programs, where no systemd runs: it restarts what ends, with growing pauses.

I/O. Each program has a session of its own, so that Ctrl-C reaches only this process; it ends the programs in the
reverse order of their start. If this process is killed, the kernel ends them, too (``PR_SET_PDEATHSIG``).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable, Sequence
from typing import Final

from gdp.enrolment.programs import MachineProgram
from gdp.errors import LocalError

__all__ = ["supervise"]

log = logging.getLogger(__name__)

_PAUSE_MIN_S: Final = 0.2
_PAUSE_MAX_S: Final = 15.0
_STEADY_S: Final = 30.0  # a program that ran this long is restarted after the shortest pause
_END_S: Final = 8.0


async def supervise(programs: Sequence[MachineProgram], started: Callable[[], Awaitable[None]] | None = None) -> None:
    """Run the programs until cancelled; then end them.

    Args:
        started: called once, when each program was started.

    Raises:
        LocalError: a program cannot be started at all.
    """
    tasks = list[asyncio.Task[None]]()
    try:
        for each in programs:
            first = asyncio.Event()
            tasks.append(asyncio.ensure_future(_keep_running(each, first)))
            begun = asyncio.ensure_future(first.wait())
            await asyncio.wait([begun, tasks[-1]], return_when=asyncio.FIRST_COMPLETED)
            begun.cancel()
            if tasks[-1].done():
                await tasks[-1]
        if started is not None:
            tasks.append(asyncio.ensure_future(_once(started)))
        await asyncio.gather(*tasks)
    finally:
        for task in reversed(tasks):
            task.cancel()
            await asyncio.wait([task])


async def _once(work: Callable[[], Awaitable[None]]) -> None:
    await work()


async def _keep_running(program: MachineProgram, first: asyncio.Event) -> None:
    pause_s, loop = _PAUSE_MIN_S, asyncio.get_running_loop()
    while True:
        begun_s = loop.time()
        process = await _start(program)
        first.set()
        log.info("program started program=%s pid=%d", program.name, process.pid)
        try:
            code = await process.wait()
        except asyncio.CancelledError:
            await _end(process)
            raise
        if loop.time() - begun_s > _STEADY_S:
            pause_s = _PAUSE_MIN_S
        log.warning("program ended program=%s code=%d pause_s=%.1f", program.name, code, pause_s)
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, _PAUSE_MAX_S)


async def _start(program: MachineProgram) -> asyncio.subprocess.Process:
    leash = ("setpriv", "--pdeathsig", "KILL", "--") if shutil.which("setpriv") is not None else ()
    try:
        return await asyncio.create_subprocess_exec(
            *leash,
            *program.argv,
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr,
            cwd="/",  # Python imports from the working directory, which others may be able to write to
            env=_environment(),
            start_new_session=True,
        )
    except OSError as error:
        raise LocalError(f"{program.name}: {program.argv[0]} cannot be started: {error.strerror}") from error


def _environment() -> dict[str, str]:
    """Return this process's environment, whose folders of modules do not depend on the working directory."""
    folders = [os.path.abspath(each) for each in os.environ.get("PYTHONPATH", "").split(os.pathsep) if each]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(folders)} if folders else dict(os.environ)


async def _end(process: asyncio.subprocess.Process) -> None:
    """Interrupt a program, and kill it if it does not end."""
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    waiting = asyncio.ensure_future(process.wait())
    await asyncio.wait([waiting], timeout=_END_S)
    if not waiting.done():
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await waiting
