"""Foreground supervisor of a machine's programs, where no systemd runs: it restarts what ends, with growing pauses.

I/O. What the programs write becomes one log on standard error, where each line begins with its program's name. Each
program has a session of its own, so that Ctrl-C reaches only this process; it ends the programs in the reverse order of
their start. If this process is killed, the kernel ends them, too (``PR_SET_PDEATHSIG``).
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
from dataclasses import dataclass, field
from typing import Final

from gdp.enrolment.programs import MachineProgram
from gdp.errors import LocalError
from gdp.intervals import STEADY_S
from gdp.requests import Backoff
from gdp.terminal import echo

log = logging.getLogger(__name__)

_RESTARTS: Final = Backoff(0.2, 15.0)
_END_S: Final = 8.0
_LINE_MAX: Final = 1 << 16


@dataclass(slots=True)
class Failures:
    """Programs that have failed: they ended by themselves less than 30 s ago, or did not end when asked."""

    names: set[str] = field(default_factory=set)


async def supervise(
    programs: Sequence[MachineProgram],
    started: Callable[[], Awaitable[None]] | None = None,
    failures: Failures | None = None,
) -> None:
    """Run the programs until cancelled; then end them.

    Args:
        started: called once, when each program was started.
        failures: filled with the programs that have failed.

    Raises:
        LocalError: a program cannot be started at all.
    """
    tasks = list[asyncio.Task[None]]()
    failures = Failures() if failures is None else failures
    width = max(len(each.name) for each in programs)
    try:
        for each in programs:
            first = asyncio.Event()
            tasks.append(asyncio.ensure_future(_keep_running(each, first, f"{each.name:<{width}} | ", failures)))
            begun = asyncio.ensure_future(first.wait())
            await asyncio.wait([begun, tasks[-1]], return_when=asyncio.FIRST_COMPLETED)
            begun.cancel()
            if tasks[-1].done():
                await tasks[-1]
        if started is not None:
            tasks.append(asyncio.ensure_future(_once(started)))
        # Unlike gather(), wait() cancels nothing when it is cancelled: the programs end one after the other, below.
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in done:
            await task
    finally:
        for task in reversed(tasks):
            task.cancel()
            await asyncio.wait([task])


async def _once(work: Callable[[], Awaitable[None]]) -> None:
    await work()


async def _keep_running(program: MachineProgram, first: asyncio.Event, prefix: str, failures: Failures) -> None:
    failed, loop = 0, asyncio.get_running_loop()
    while True:
        begun_s = loop.time()
        process = await _start(program)
        first.set()
        log.info("program started program=%s pid=%d", program.name, process.pid)
        logging_output = asyncio.ensure_future(_log_output(process, prefix))
        try:
            code = await process.wait()
        except asyncio.CancelledError:
            if loop.time() - begun_s > STEADY_S:
                failures.names.discard(program.name)
            if not await _end(process):
                failures.names.add(program.name)
            await asyncio.wait([logging_output], timeout=_END_S)
            raise
        failed = 1 if loop.time() - begun_s > STEADY_S else failed + 1
        pause_s = _RESTARTS.pause_s(failed)
        failures.names.add(program.name)
        log.warning("program ended program=%s code=%d pause_s=%.1f", program.name, code, pause_s)
        await asyncio.sleep(pause_s)


async def _log_output(process: asyncio.subprocess.Process, prefix: str) -> None:
    """Copy a program's lines to standard error, each behind the prefix; a longer one than 64 KiB comes in parts."""
    if process.stdout is None:
        return
    rest = b""
    while data := await process.stdout.read(_LINE_MAX):
        *lines, rest = (rest + data).split(b"\n")
        if len(rest) >= _LINE_MAX:
            lines, rest = [*lines, rest], b""
        for line in lines:
            echo(f"{prefix}{line.decode(errors='replace')}", err=True)
        sys.stderr.flush()
    if rest:
        echo(f"{prefix}{rest.decode(errors='replace')}", err=True)
        sys.stderr.flush()


async def _start(program: MachineProgram) -> asyncio.subprocess.Process:
    leash = ("setpriv", "--pdeathsig", "KILL", "--") if shutil.which("setpriv") is not None else ()
    try:
        return await asyncio.create_subprocess_exec(
            *leash,
            *program.argv,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
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


async def _end(process: asyncio.subprocess.Process) -> bool:
    """Interrupt a program, and kill it if it does not end; return whether it ended by itself."""
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    waiting = asyncio.ensure_future(process.wait())
    await asyncio.wait([waiting], timeout=_END_S)
    if waiting.done():
        return True
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    await waiting
    return False
