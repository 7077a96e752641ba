"""Child process of an asyncio program: one of the project's commands, whose lines are events.

I/O. Built on ``subprocess`` and a pidfd rather than on asyncio's own subprocesses, whose transports kill running
processes when they are garbage-collected. A kept ring must outlive this process.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncGenerator, Mapping, Sequence
from typing import Final

from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.events import Event
from lab.process import FailedError, LabProcess

_LINE_MAX_BYTES: Final = 16 << 20  # the report on a recording of many topics
_TAIL_LINES: Final = 12


class Child(LabProcess):
    """One process; every method that waits for it may raise ``FailedError``, with its last lines."""

    def __init__(
        self, run: Run, label: str, argv: Sequence[str], *, heard: bool, environment: Mapping[str, str] | None
    ) -> None:
        super().__init__(run, label, argv, heard=heard, environment=environment)
        self.ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._lines: asyncio.StreamReader | None = None
        self._transport: asyncio.BaseTransport | None = None
        self._pidfd = os.pidfd_open(self.pid)
        asyncio.get_running_loop().add_reader(self._pidfd, self._reap)

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

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process, unless it has ended."""
        if not self.ended.done():
            super().send(number)

    def failed(self, how: str) -> FailedError:
        """Return the error for this process's failure, with the last lines of its log."""
        return FailedError("\n    ".join([f"{self.label} {how}", *self.last_lines(_TAIL_LINES)]))

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
            if self._process.stdout is None:
                raise LocalError(f"{self.label} has no output to read")
            loop = asyncio.get_running_loop()
            lines = self._lines = asyncio.StreamReader(limit=_LINE_MAX_BYTES, loop=loop)
            self._transport, _ = await loop.connect_read_pipe(
                lambda: asyncio.StreamReaderProtocol(lines, loop=loop), self._process.stdout
            )
        return self._lines

    def _reap(self) -> None:
        """Read the exit code; the loop calls it when the process has ended."""
        asyncio.get_running_loop().remove_reader(self._pidfd)
        if not self.ended.done():
            self.ended.set_result(self._process.wait())
