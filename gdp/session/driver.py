"""Thread driver of a session: the thread that waits drives the node.

I/O. One thread at a time leads: it holds the lock, waits for frames, and lets the core distribute them.

    a thread that waits for a message   leads until it has one; so a message wakes one thread, not two
    further threads that wait           follow: the leader wakes them when their condition has come true
    no thread waits                     the background thread leads, once none has for ``SCHEDULED_S``
    a thread that publishes             does it itself if no thread leads; else it passes the message to the leader

Commands are passed without lost wake-ups: a thread queues its command before it finds the lock taken, and the thread
that releases the lock checks the queue afterwards (flat combining; Hendler et al., SPAA 2010).
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final, Protocol, TypeVar

from gdp.client.publisher import Publisher
from gdp.errors import GdpError
from gdp.intervals import SCHEDULED_S
from gdp.runtime.runtime import Runtime
from gdp.session.protocol.core import SessionCore
from gdp.session.protocol.errors import ClosedError

log = logging.getLogger(__name__)

T = TypeVar("T")

_QUEUED_MAX: Final = 1_024  # messages queued for the leader; a thread with more waits for the leader
_COPY_MAX_BYTES: Final = 65_536  # a larger message is passed only if the leader takes it at once
_SMALL_BYTES: Final = 1_024  # a message of this size leaves with one send


class Driver(Protocol):
    """Interface of a driver to its session."""

    def now_s(self) -> float:
        """Return the present monotonic second."""

    def run(self, command: Callable[[], T]) -> T:
        """Run a command on the node and return what it returns; it must not block."""

    def publish(self, publisher: Publisher, message: bytes) -> None:
        """Publish a message, now or when the leader takes it."""

    def wait(self, is_ready: Callable[[], bool], deadline_s: float | None) -> bool:
        """Work until ``is_ready``, or until a monotonic second; return whether it came true."""

    def close(self) -> None:
        """End the background work."""


class _Wake:
    """An eventfd(2) that ends the leader's wait."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._is_set = False

    def fileno(self) -> int:
        """Return the descriptor that the runtime watches."""
        return self._fd

    def set(self) -> None:
        """End the leader's wait; any thread may."""
        if not self._is_set:  # one wake-up serves many commands
            self._is_set = True
            os.eventfd_write(self._fd, 1)

    def clear(self) -> None:
        """Allow the leader to wait again."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._fd)
        self._is_set = False  # last: a thread that finds it set has queued a command that the leader checks next

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self._fd)


class _Follower:
    """A thread that waits while another one leads."""

    __slots__ = ("event", "is_ready")

    def __init__(self, is_ready: Callable[[], bool]) -> None:
        self.is_ready = is_ready
        self.event = threading.Event()


class ThreadDriver:
    """Driver of a core over a runtime; ``close`` ends it."""

    def __init__(self, core: SessionCore, runtime: Runtime) -> None:
        self._core = core
        self._member = core.member
        self._runtime = runtime
        self._lock = threading.Lock()
        self._commands: deque[Callable[[], None]] = deque()
        self._followers: deque[_Follower] = deque()
        self._wake = _Wake()
        runtime.watch(self._wake, self._wake.clear)
        self._leads = 0  # how often a thread of the program has led
        self._is_led = False  # by a thread of the program
        self._is_pending = False  # the background thread sleeps until a leader leaves
        self._unparked = threading.Event()
        self._is_closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._background, name="gdp-session", daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Return the present monotonic second."""
        return time.monotonic()

    def run(self, command: Callable[[], T]) -> T:
        """Run a command on the node and return what it returns. Raises ``ClosedError``: the session is closed."""
        done = threading.Event()
        results: list[T] = []
        errors: list[BaseException] = []

        def execute() -> None:
            """Run the command and store its result or error."""
            try:
                results.append(command())
            except BaseException as error:  # re-raised in the thread that queued the command
                errors.append(error)
            done.set()

        self._check()
        self._commands.append(execute)
        self._drain_or_wake()
        while not done.wait(1.0):
            self._check()  # the leader may have failed
            self._drain_or_wake()
        if errors:
            raise errors[0]
        return results[0]

    def publish(self, publisher: Publisher, message: bytes) -> None:
        """Publish a message, now or when the leader takes it.

        Raises:
            LocalError: it is above the limits.
            ClosedError: the session is closed.
        """
        if self._is_closed:
            self._check()
        if self._lock.acquire(blocking=False):
            try:
                if self._commands:
                    self._run_commands()
                publisher.publish(message, time.monotonic())
                self._send(len(message))
            finally:
                self._lock.release()
            if self._commands or self._followers:
                self._after_release()
        elif len(message) > _COPY_MAX_BYTES or len(self._commands) >= _QUEUED_MAX:
            self.run(partial(publisher.publish, message, time.monotonic()))
        else:
            self._commands.append(partial(_publish_or_log, publisher, message, time.monotonic()))
            self._drain_or_wake()

    def wait(self, is_ready: Callable[[], bool], deadline_s: float | None) -> bool:
        """Work until ``is_ready``, or until a monotonic second; return whether it came true.

        Raises:
            ClosedError: the session is closed, or was closed during the wait.
        """
        while True:
            if self._lock.acquire(blocking=False):
                if self._lead(is_ready, deadline_s):
                    return True
            elif self._follow(is_ready, deadline_s):
                return True
            if deadline_s is not None and time.monotonic() >= deadline_s:
                return is_ready()
            self._check()

    def close(self) -> None:
        """End the background work; threads that wait get ``ClosedError``."""
        if self._is_closed:
            return
        self._is_closed = True
        self._wake.set()
        self._unparked.set()
        for follower in list(self._followers):
            follower.event.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()
        with self._lock:  # waits until a leading thread releases it
            self._runtime.unwatch(self._wake)
            self._wake.close()

    # leading

    def _lead(self, is_ready: Callable[[], bool], deadline_s: float | None) -> bool:
        """Work as the leader until ready, and release the held lock; return whether it is ready."""
        self._is_led = True
        self._leads += 1
        try:
            while not is_ready():
                if self._is_closed or (deadline_s is not None and time.monotonic() >= deadline_s):
                    return False
                self._step(deadline_s)
            return True
        except Exception as error:
            self._error = error
            raise
        finally:
            self._is_led = False
            self._lock.release()
            if self._is_pending:
                self._unparked.set()
            if self._commands or self._followers:
                self._after_release()

    def _step(self, deadline_s: float | None) -> None:
        core = self._core
        if self._commands:
            self._run_commands()
        due_s = core.get_timer()
        if due_s is None or (deadline_s is not None and deadline_s < due_s):
            due_s = deadline_s
        self._runtime.step(due_s)
        now_s = time.monotonic()
        core.handle(now_s)
        if self._commands:
            self._run_commands()
        if core.has_services:
            self._send(0)  # messages of servers and clients must not wait for the next step
        for follower in list(self._followers) if self._followers else ():
            if follower.is_ready():
                follower.event.set()

    def _run_commands(self) -> None:
        commands = self._commands
        while commands:
            commands.popleft()()
        self._send(0)

    def _send(self, size_bytes: int) -> None:
        self._member.flush(time.monotonic())
        is_more = self._runtime.send()
        while is_more and size_bytes > _SMALL_BYTES:  # confirmations that arrive in the meantime open the window
            self._step(0.0)  # that second has passed, so it does not wait
            is_more = self._runtime.send()

    # not leading

    def _follow(self, is_ready: Callable[[], bool], deadline_s: float | None) -> bool:
        """Wait until the leader reports the condition, or no thread leads; return whether it is true."""
        follower = _Follower(is_ready)
        self._followers.append(follower)
        try:
            if not (self._is_led or self._is_closed):
                self._wake.set()  # the background thread releases the lock
            if is_ready() or not self._lock.locked():  # it may have changed before the leader saw this follower
                return is_ready()
            follower.event.wait(None if deadline_s is None else max(deadline_s - time.monotonic(), 0.0))
            return is_ready()
        finally:
            self._followers.remove(follower)

    def _drain_or_wake(self) -> None:
        """Run the queued commands: here if no thread leads, else in the leader."""
        while self._commands:
            if not self._lock.acquire(blocking=False):
                if not self._is_closed:
                    self._wake.set()
                return
            try:
                self._run_commands()
            finally:
                self._lock.release()
            self._promote()

    def _after_release(self) -> None:
        if self._commands:
            self._drain_or_wake()
        if self._followers:
            self._promote()

    def _promote(self) -> None:
        """Wake a follower, so that it leads."""
        try:
            self._followers[0].event.set()
        except IndexError:
            return

    # the background thread

    def _background(self) -> None:
        try:
            while not self._is_closed:
                leads = self._leads
                if not self._followers and not self._is_led and self._lock.acquire(blocking=False):
                    self._lead_in_background()
                self._park(leads)
        except Exception as error:
            log.exception("the session's node failed")
            self._error = error
            for follower in list(self._followers):
                follower.event.set()

    def _lead_in_background(self) -> None:
        try:
            while not self._is_closed and not self._followers:
                self._step(None)
        finally:
            self._lock.release()
            self._after_release()

    def _park(self, leads: int) -> None:
        """Sleep while threads of the program lead, and for a grace time after."""
        while not self._is_closed:
            self._unparked.wait(SCHEDULED_S)
            if self._leads == leads and not self._is_led and not self._followers:
                return
            if self._leads == leads and self._is_led:  # the same leader has waited for the whole time
                self._unparked.clear()
                self._is_pending = True
                if self._is_led and not self._is_closed:
                    self._unparked.wait()
                self._is_pending = False
                self._unparked.clear()
            leads = self._leads

    def _check(self) -> None:
        if self._error is not None:
            raise ClosedError(f"the session has failed: {self._error!r}; open a new one") from self._error
        if self._is_closed:
            raise ClosedError("the session is closed; open a new one")


def _publish_or_log(publisher: Publisher, message: bytes, now_s: float) -> None:
    try:
        publisher.publish(message, now_s)
    except GdpError as error:  # the size was checked before
        log.error("a message was not published reason=%s", error)
