"""Event loop of a relay: descriptors with handlers, timers with millisecond precision, signals.

I/O. One thread serves all connections without ever blocking on one, because the work for each frame is small and the
system calls dominate it.
"""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from gdp.intervals import NEVER_S, UPKEEP_S
from gdp.ports.plane import HasFileno
from gdp.runtime.memory_tuning import tune_memory
from gdp.runtime.runtime import Periodic, now
from gdp.runtime.signals import handled_signals
from gdp.sansio import Timestamps


class Timed(Protocol):
    """A part of the relay with timers."""

    def handle_timer(self, now_s: float) -> float:
        """Do what is due at a monotonic second; return the second of the next call."""


class _TimedPeriodic(Periodic):
    """Function that the loop calls once in a period, however often the timers are."""

    def handle_timer(self, now_s: float) -> float:
        """Call the function if it is due; return the second of the next call."""
        if now_s >= self.due_s:
            self.handle(now())
        return self.due_s if self.has_work() else NEVER_S


class RelayLoop:
    """The loop; ``close`` releases its descriptors."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._handlers: dict[int, Callable[[int], None]] = {}
        self._timed: list[Timed] = []
        self._due_s = 0.0
        self._is_stopped = False

    def close(self) -> None:
        """Release the loop's own descriptor."""
        self._epoll.close()

    def register(self, fd: int, events: int, handler: Callable[[int], None]) -> None:
        """Call ``handler`` with the ``EPOLL`` events of a descriptor, until ``unregister``."""
        self._handlers[fd] = handler
        self._epoll.register(fd, events)

    def modify(self, fd: int, events: int) -> None:
        """Wait for other events of a descriptor."""
        self._epoll.modify(fd, events)

    def unregister(self, fd: int) -> None:
        """Forget a descriptor, before it is closed."""
        del self._handlers[fd]
        self._epoll.unregister(fd)

    def add_timed(self, part: Timed) -> None:
        """Call a part's timers from now on, the first time at once."""
        self._timed.append(part)
        self._due_s = 0.0

    def watch(self, source: HasFileno, ready: Callable[[], None]) -> None:
        """Call ``ready`` whenever a source is readable, until ``unwatch``."""
        self.register(source.fileno(), select.EPOLLIN, lambda _: ready())

    def unwatch(self, source: HasFileno) -> None:
        """Undo ``watch``, before the source is closed."""
        self.unregister(source.fileno())

    def every(
        self, period_s: float, function: Callable[[Timestamps], None], has_work: Callable[[], object] = lambda: True
    ) -> None:
        """Call a function each ``period_s``, the first time at once; not while it has no work."""
        self.add_timed(_TimedPeriodic(period_s, function, has_work))

    def remove_timed(self, part: Timed) -> None:
        """Call a part's timers no more."""
        self._timed.remove(part)

    def wake_at(self, mono_s: float) -> None:
        """Call the timers at this monotonic second at the latest."""
        self._due_s = min(self._due_s, mono_s)

    def stop(self) -> None:
        """End ``run`` after the present step."""
        self._is_stopped = True

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Work until ``stop``, or until ``until`` is true (checked after each step)."""
        self._is_stopped = False
        while not self._is_stopped and not until():
            self.step()

    def step(self) -> None:
        """Call the timers that are due, and wait once for events."""
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + UPKEEP_S
            for part in list(self._timed):
                self.wake_at(part.handle_timer(now_s))
        handlers = self._handlers
        for fd, events in self._epoll.poll(max(self._due_s - time.monotonic(), 0.0)):
            handler = handlers.get(fd)
            if handler is not None:  # an earlier event of this step may have closed it
                handler(events)

    @contextlib.contextmanager
    def signals(self, reload: Callable[[], None]) -> Iterator[None]:
        """End ``run`` on SIGINT and SIGTERM, and call ``reload`` on SIGHUP, until the context ends."""
        tune_memory()
        with handled_signals(self.stop, reload) as (reading, drain):
            self.watch(reading, drain)
            try:
                yield
            finally:
                self.unwatch(reading)
