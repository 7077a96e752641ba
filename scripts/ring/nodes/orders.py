"""Orders to a node of a live ring, and its reports: two signals in, lines of JSON out.

I/O. Signals are blocked and waited for, so none interrupts anything; SIGTERM ends the process as always.
"""

from __future__ import annotations

import json
import os
import signal
import time
from enum import Enum
from typing import Final, NoReturn

_STDOUT: Final = 1
_LONG_S: Final = 3_600.0


class Order(Enum):
    """Order to a node."""

    GO = signal.SIGUSR1  # the other side receives: begin; after a report: continue without counting
    REPORT = signal.SIGINT


class Orders:
    """The orders to this process. Create it first: threads that exist already would receive the signals."""

    def __init__(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, [order.value for order in Order])

    def wait(self, seconds: float) -> Order | None:
        """Return the next order, or None after this many seconds."""
        found = signal.sigtimedwait([order.value for order in Order], max(seconds, 0.0))
        return None if found is None else Order(found.si_signo)

    def wait_until(self, at_s: float) -> None:
        """Return at a monotonic second; orders before that are discarded."""
        while (left_s := at_s - time.monotonic()) > 0:
            self.wait(left_s)

    def wait_for(self, order: Order) -> None:
        """Return when the order arrives; other orders before that are discarded."""
        while self.wait(_LONG_S) is not order:
            continue

    def wait_for_the_end(self) -> NoReturn:
        """Wait until killed, while threads work."""
        while True:
            self.wait(_LONG_S)


def say(event: str, **fields: object) -> None:
    """Write one line of JSON."""
    line = memoryview(json.dumps({"event": event, **fields}).encode() + b"\n")
    while line:
        line = line[os.write(_STDOUT, line) :]
