"""Children of a run, supervised together: the end of any required process also ends the present wait.

I/O. A child is one of the project's commands, whose lines are events. It is built on ``subprocess`` and a pidfd rather
than on asyncio's own subprocesses, whose transports kill running processes when they are garbage-collected. A kept ring
must outlive this process.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterable, Mapping, Sequence
from typing import Final, TypeVar

from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.events import Event
from lab.namespaces import Namespaces
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

        Raises ``LocalError``: its output is not an event.
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


READY_S: Final = 60.0

T = TypeVar("T")


class Children:
    """The processes of one run.

    Args:
        run: records each of them, so that the clean-up of the run ends it.
        kept: they outlive this process; otherwise the kernel kills them when it ends for any reason.
        started: called with machine and process id of each process that runs in a namespace.
    """

    def __init__(self, run: Run, *, kept: bool, started: Callable[[str, int], None] | None = None) -> None:
        self._started = started
        self._run = run
        self._kept = kept
        self._all: list[Child] = []
        self._standing: list[Child] = []
        self._changed = asyncio.Event()  # set when the set of required processes changes

    def start(
        self,
        label: str,
        argv: Sequence[str],
        *,
        heard: bool = True,
        environment: Mapping[str, str] | None = None,
    ) -> Child:
        """Start a process; ``environment`` extends the present one."""
        child = Child(self._run, label, argv, heard=heard, environment=environment)
        self._all.append(child)
        return child

    def start_in(
        self,
        namespaces: Namespaces,
        node: str,
        role: str,
        arguments: Sequence[str],
        *,
        heard: bool = True,
        environment: Mapping[str, str] | None = None,
    ) -> Child:
        """Start Python with these arguments in the namespace of a switch; ``environment`` extends the present one."""
        argv = namespaces[node].command([sys.executable, *arguments], dies_with_us=not self._kept)
        child = self.start(f"{role} {node}", argv, heard=heard, environment=environment)
        if self._started is not None:
            self._started(node, child.pid)
        return child

    async def ready(self, children: Sequence[Child]) -> list[Event]:
        """Wait until each has reported ``ready``, and return these events; from then on they are required."""
        said = await self.guarded(gathered(child.wait_for("ready", READY_S) for child in children))
        self._standing += children
        self._changed.set()
        return said

    def may_end(self, child: Child) -> None:
        """Expect the end of this process from now on."""
        self._standing.remove(child)
        self._changed.set()

    async def kill(self, child: Child) -> None:
        """Kill a required process; return when it has ended."""
        self.may_end(child)
        child.send(signal.SIGKILL)
        await child.ended

    async def guarded(self, work: Coroutine[None, None, T]) -> T:
        """Run ``work``, but stop at once if a required process ends."""
        task = asyncio.ensure_future(work)
        fallen = asyncio.ensure_future(self._first_to_fall())
        try:
            await asyncio.wait([task, fallen], return_when=asyncio.FIRST_COMPLETED)
            if not task.done():
                child = fallen.result()
                raise child.failed(f"ended with code {child.ended.result()}")
            return task.result()
        finally:
            await cancel(task, fallen)

    def forget(self) -> None:
        """Close the descriptors here; the processes continue."""
        for child in self._all:
            child.forget()

    async def _first_to_fall(self) -> Child:
        while True:
            for child in self._standing:
                if child.ended.done():
                    return child
            self._changed.clear()
            changed = asyncio.ensure_future(self._change())
            try:
                endings = [child.ended for child in self._standing]
                await asyncio.wait([changed, *endings], return_when=asyncio.FIRST_COMPLETED)
            finally:
                changed.cancel()

    async def _change(self) -> int:
        await self._changed.wait()
        return len(self._standing)


async def cancel(*tasks: asyncio.Future[T] | asyncio.Future[Child]) -> None:
    """Cancel what is under way and wait until it has stopped; its errors were reported elsewhere already."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def gathered(works: Iterable[Coroutine[None, None, Event]]) -> list[Event]:
    """Run all at once; return their events in order."""
    return await asyncio.gather(*works)
