"""Loop driver of a session for asyncio: the event loop of the program drives the node, without a thread.

I/O. The loop watches the plane's epoll descriptor and one timer; each step is short and does not wait.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Final, TypeVar

from gdp.client.publisher import Publisher
from gdp.due_queue import earliest
from gdp.ports.netdev import NetdevPlane
from gdp.runtime.runtime import Runtime
from gdp.session.protocol.core import SessionCore
from gdp.session.protocol.errors import ClosedError

log = logging.getLogger(__name__)

T = TypeVar("T")

_STEPS_MAX: Final = 8  # before the program's other tasks run


class LoopDriver:
    """Driver of a core in the running event loop; only that loop's thread may use it."""

    def __init__(self, core: SessionCore, runtime: Runtime, plane: NetdevPlane) -> None:
        self._core = core
        self._member = core.member
        self._runtime = runtime
        self._plane = plane
        self._loop = asyncio.get_running_loop()
        self._waiters: dict[asyncio.Future[bool], Callable[[], bool]] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._is_scheduled = False
        self._is_closed = False
        self._error: Exception | None = None
        self._loop.add_reader(plane.fileno(), self._work)
        self.schedule()

    def now_s(self) -> float:
        """Return the present monotonic second."""
        return time.monotonic()

    def run(self, command: Callable[[], T]) -> T:
        """Run a command on the node and return what it returns. Raises ``ClosedError``: the session is closed."""
        self.check()
        result = command()
        self.schedule()
        return result

    def publish(self, publisher: Publisher, message: bytes) -> None:
        """Publish a message now.

        Raises:
            LocalError: it is above the limits.
            ClosedError: the session is closed.
        """
        self.check()
        now_s = time.monotonic()
        publisher.publish(message, now_s)
        self._member.flush(now_s)
        self._runtime.send()
        self.schedule()

    async def wait(self, is_ready: Callable[[], bool], deadline_s: float | None) -> bool:
        """Wait until ``is_ready``, or until a monotonic second; return whether it came true.

        Raises:
            ClosedError: the session is closed, or was closed during the wait.
        """
        if is_ready():
            return True
        self.check()
        future: asyncio.Future[bool] = self._loop.create_future()
        self._waiters[future] = is_ready
        timer = None
        if deadline_s is not None:  # wait_for would lose a cancellation (CPython issue 86296)
            timer = self._loop.call_later(deadline_s - time.monotonic(), _end_wait, future)
        try:
            was_ready = await future
        finally:
            self._waiters.pop(future, None)
            if timer is not None:
                timer.cancel()
        self.check()
        return was_ready or is_ready()

    def schedule(self) -> None:
        """Schedule a step soon, because the node has new work."""
        if not self._is_scheduled and not self._is_closed:
            self._is_scheduled = True
            self._loop.call_soon(self._scheduled)

    def check(self) -> None:
        """Return if the session works. Raises ``ClosedError``: it is closed, or has failed."""
        if self._error is not None:
            raise ClosedError(f"the session has failed: {self._error!r}; open a new one") from self._error
        if self._is_closed:
            raise ClosedError("the session is closed; open a new one")

    def close(self) -> None:
        """End the work; tasks that wait get ``ClosedError``."""
        if self._is_closed:
            return
        self._is_closed = True
        self._loop.remove_reader(self._plane.fileno())
        if self._timer is not None:
            self._timer.cancel()
        self._wake_all()

    def _scheduled(self) -> None:
        self._is_scheduled = False
        if not self._is_closed:
            self._work()

    def _work(self) -> None:
        """Take steps while there is work, then set the timer."""
        try:
            for _ in range(_STEPS_MAX):
                now_s = time.monotonic()
                self._runtime.step(now_s)  # that second has passed, so it does not wait
                self._core.handle(time.monotonic())
                if not self._runtime.send():
                    break
            else:
                self.schedule()
            self._set_timer()
        except Exception as error:
            log.exception("the session's node failed")
            self._error = error
            self.close()
            return
        for future, is_ready in list(self._waiters.items()):
            if not future.done() and is_ready():
                future.set_result(True)

    def _set_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        due_s = earliest(self._runtime.next_due_s(), self._core.get_timer())
        if due_s is not None:
            delay_s = max(due_s - time.monotonic(), 0.0)
            self._timer = self._loop.call_later(delay_s, self._work)

    def _wake_all(self) -> None:
        for future in list(self._waiters):
            _end_wait(future)


def _end_wait(future: asyncio.Future[bool]) -> None:
    if not future.done():
        future.set_result(False)
