"""Children of a run, supervised together: the end of any required process also ends the present wait.

I/O.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from typing import Final, TypeVar

from gdp.host.run_registry import Run
from lab.child import Child
from lab.events import Event
from lab.namespaces import Namespaces

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
