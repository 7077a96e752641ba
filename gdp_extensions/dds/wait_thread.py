"""Wait-set thread: waits for Cyclone DDS and reads its samples; the caller's thread processes them.

I/O. Listeners of the binding run Python in Cyclone's own threads, with its locks held; this thread holds none. The
queue is short: while the caller does not poll, samples wait in their readers, which keep the newest.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import Final, TypeAlias

from cyclonedds.core import GuardCondition
from cyclonedds.domain import DomainParticipant

from gdp_extensions.dds.library import WaitSet

log = logging.getLogger(__name__)

_QUEUE_MAX: Final = 64

News: TypeAlias = Callable[[], None]  # processing of the samples, in the caller's thread
Drain: TypeAlias = Callable[[], News | None]  # reads the samples, in the wait-set thread


class WaitThread:
    """Waits for conditions of one participant."""

    def __init__(self, participant: DomainParticipant) -> None:
        self._set = WaitSet(participant._ref)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._queue = deque[News]()
        self._capacity = threading.Event()
        self._drains: dict[int, Drain] = {}
        self._numbers = count(1)
        self._is_closing = False
        self._stop = GuardCondition(participant)
        self._set.attach(self._stop._ref, 0)
        self._thread = threading.Thread(target=self._run, name="dds watch", daemon=True)
        self._thread.start()

    def add(self, entity: int, drain: Drain) -> int:
        """Watch a condition, or the status of a reader or writer; return a number for ``remove``.

        Args:
            drain: called until the condition no longer holds.
        """
        number = next(self._numbers)
        self._drains[number] = drain
        self._set.attach(entity, number)
        return number

    def remove(self, entity: int, number: int) -> None:
        """Stop watching; ``drain`` may run once more."""
        self._set.detach(entity)
        del self._drains[number]

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``catch_up`` has work."""
        return self._wake

    def wake(self) -> None:
        """Make the descriptor readable: the caller has news of its own."""
        os.eventfd_write(self._wake, 1)

    def catch_up(self) -> None:
        """Process what was read."""
        try:
            os.eventfd_read(self._wake)
        except BlockingIOError:
            return
        for _ in range(len(self._queue)):
            self._queue.popleft()()
            self._capacity.set()
        if self._queue:
            self.wake()

    def close(self) -> None:
        """End the thread and free everything."""
        self._is_closing = True
        self._stop.set(True)
        self._capacity.set()
        self._thread.join()
        self._set.delete()
        os.close(self._wake)

    def _run(self) -> None:
        while True:
            numbers = self._set.wait()
            if 0 in numbers:
                return
            for number in numbers:
                drain = self._drains.get(number)
                if drain is not None:
                    self._read_available(drain)

    def _read_available(self, drain: Drain) -> None:
        try:
            news = drain()
        except Exception as error:  # the binding may fail in any way on a peer's announcement
            log.warning("something in DDS could not be read reason=%s", error)
            return
        if news is not None:
            self._put(news)

    def _put(self, news: News) -> None:
        self._queue.append(news)
        if len(self._queue) == 1:
            self.wake()
        self._capacity.clear()
        if len(self._queue) >= _QUEUE_MAX and not self._is_closing:
            self._capacity.wait()
