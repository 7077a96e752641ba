"""Interruption of work by a signal, so that the caller can still remove what the work made."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from typing import Final, TypeVar

T = TypeVar("T")

_ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(Exception):  # noqa: N818  (not an error)
    """A signal cancelled the work; ``exit_code``: exit code of a shell for that signal."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


async def interruptible(work: Coroutine[None, None, T]) -> T:
    """Do the work and return its result. Raises ``Interrupted``: a signal cancelled it."""
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(work)
    caught: list[int] = []

    def stop(number: int) -> None:
        """Cancel the work, and remember the signal."""
        caught.append(number)
        task.cancel()

    for number in _ENDING_SIGNALS:
        loop.add_signal_handler(number, stop, number)
    try:
        return await task
    except asyncio.CancelledError:
        raise Interrupted(caught[0]) from None


def let_nothing_interrupt() -> None:
    """Ignore these signals from now on: what follows takes seconds at most, and must run to its end."""
    for number in _ENDING_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
