"""Signals of a loop: SIGINT and SIGTERM stop it, SIGHUP reloads, and each wakes a blocked wait.

I/O. Source: Python's ``signal.set_wakeup_fd``: the number of a signal is a byte on a socket that the loop reads.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import socket
from collections.abc import Callable, Iterator
from types import FrameType

log = logging.getLogger(__name__)


@contextlib.contextmanager
def handled_signals(
    stop: Callable[[], None], reload: Callable[[], None] | None
) -> Iterator[tuple[socket.socket, Callable[[], None]]]:
    """Handle signals until the context ends; called in the main thread.

    Args:
        stop: called at once, on SIGINT and SIGTERM.
        reload: called on SIGHUP by the function that is yielded.

    Yields:
        A socket that is readable after a signal, and the function that the loop calls then.
    """
    reading, writing = socket.socketpair()
    reading.setblocking(False)
    writing.setblocking(False)

    def end(number: int, frame: FrameType | None) -> None:
        """Stop the loop."""
        del frame
        log.info("stopping signal=%d", number)
        stop()

    def hang_up(number: int, frame: FrameType | None) -> None:
        """Do nothing here: ``drain`` handles the number on the socket."""
        del number, frame

    def drain() -> None:
        """Read the numbers of signals, and reload on SIGHUP."""
        with contextlib.suppress(BlockingIOError):
            while numbers := reading.recv(64):
                if signal.SIGHUP in numbers and reload is not None:
                    reload()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    before[signal.SIGHUP] = signal.signal(signal.SIGHUP, hang_up)
    woken_before = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
    try:
        yield reading, drain
    finally:
        signal.set_wakeup_fd(woken_before)
        for number, handler in before.items():
            signal.signal(number, handler)
        reading.close()
        writing.close()
