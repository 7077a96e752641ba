"""Child process of the ring: one of the project's commands, started, read and ended.

I/O. Built on ``subprocess`` and a pidfd rather than on asyncio's own subprocesses, whose transports kill running
processes when they are garbage-collected. A kept ring must outlive this process.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
from collections import deque
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path
from typing import IO, Final

from gdp.errors import GdpError, LocalError
from ring.events import Event

__all__ = ["Child", "ChildError"]

_LINE_MAX_BYTES: Final = 16 << 20  # the report on a recording of many topics
_TAIL_LINES: Final = 12


class ChildError(GdpError):
    """A process ended too early, or did not report the awaited event in time; the text shows its last lines.

    Every method of the harness that waits for processes may raise it.
    """


class Child:
    """One process, leader of its own group. Its standard error goes to ``log``, its standard output is read as events.

    Args:
        label: display name, such as ``switch nuc1``.
        argv: the command line; inherited by exec, so that the process id stays.
        heard: False: its standard output is not read, and goes to the log too.
    """

    def __init__(self, label: str, argv: Sequence[str], log: Path, *, heard: bool = True) -> None:
        self.label = label
        self.log = log
        self.ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._lines: asyncio.StreamReader | None = None
        self._transport: asyncio.BaseTransport | None = None
        with log.open("wb") as errors:
            output = subprocess.PIPE if heard else errors
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                argv, stdin=subprocess.DEVNULL, stdout=output, stderr=errors, start_new_session=True
            )
        self._pidfd = os.pidfd_open(self.pid)
        asyncio.get_running_loop().add_reader(self._pidfd, self._reap)

    @property
    def pid(self) -> int:
        """Return the process id, which is also its group's."""
        return self._process.pid

    async def events(self) -> AsyncGenerator[Event, None]:
        """Yield the events of the process, until it closes its output.

        Raises:
            LocalError: its output is not an event.
        """
        lines = await self._open()
        while line := await lines.readline():
            yield Event.from_line(line.decode("utf-8", "replace"))

    async def wait_for(self, name: str, patience_s: float) -> Event:
        """Return the next event of this name; others on the way are skipped."""
        try:
            return await asyncio.wait_for(self._next(name), patience_s)
        except asyncio.TimeoutError:
            raise self.failed(f"did not say {name!r} within {patience_s:g} s") from None

    async def wait(self, patience_s: float) -> int:
        """Return the exit code."""
        try:
            return await asyncio.wait_for(asyncio.shield(self.ended), patience_s)
        except asyncio.TimeoutError:
            raise self.failed(f"still runs after {patience_s:g} s") from None

    def interrupt(self) -> None:
        """Request the process to finish its work and end."""
        if not self.ended.done():
            self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill the process immediately."""
        if not self.ended.done():
            self._process.kill()

    def go(self) -> None:
        """Signal a node of a live run to begin, or to continue after its report."""
        if not self.ended.done():
            self._process.send_signal(signal.SIGUSR1)

    def failed(self, how: str) -> ChildError:
        """Return the error for this process's failure, with the last lines of its log."""
        with self.log.open(encoding="utf-8", errors="replace") as file:
            tail = deque((line.rstrip() for line in file), maxlen=_TAIL_LINES)
        return ChildError("\n".join([f"{self.label} {how}", *(f"    {line}" for line in tail if line)]))

    def forget(self) -> None:
        """Close the descriptors here; the process itself continues."""
        if self._pidfd >= 0:
            asyncio.get_running_loop().remove_reader(self._pidfd)
            os.close(self._pidfd)
            self._pidfd = -1
        if self._transport is not None:
            self._transport.close()
        elif self._process.stdout is not None:
            self._process.stdout.close()

    async def _next(self, name: str) -> Event:
        async with contextlib.aclosing(self.events()) as events:
            async for event in events:
                if event.name == name:
                    return event
        raise self.failed(f"ended with code {await self.ended} before it said {name!r}")

    async def _open(self) -> asyncio.StreamReader:
        if self._lines is None:
            output = self._process.stdout
            if output is None:
                raise LocalError(f"{self.label} has no output to read")
            self._lines = await self._connect(output)
        return self._lines

    async def _connect(self, output: IO[bytes]) -> asyncio.StreamReader:
        loop = asyncio.get_running_loop()
        lines = asyncio.StreamReader(limit=_LINE_MAX_BYTES, loop=loop)
        self._transport, _ = await loop.connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(lines, loop=loop), output
        )
        return lines

    def _reap(self) -> None:
        """Read the exit code; the loop calls it when the process has ended."""
        asyncio.get_running_loop().remove_reader(self._pidfd)
        if not self.ended.done():
            self.ended.set_result(self._process.wait())
