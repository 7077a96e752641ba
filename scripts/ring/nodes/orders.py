"""How a node of a live ring is told, and tells: two signals in, lines of JSON out.

Place: shell. Signals are blocked and waited for, so none interrupts anything; SIGTERM ends the process as always.
"""

from __future__ import annotations

import json
import os
import signal
import time
from enum import Enum
from typing import Final, NoReturn

__all__ = ["Order", "Orders", "say"]

_STDOUT: Final = 1
_LONG_S: Final = 3_600.0


class Order(Enum):
    """What may be asked."""

    GO = signal.SIGUSR1  # the other end hears: begin; after a report: go on, nobody counts any more
    REPORT = signal.SIGINT


class Orders:
    """The orders to this process. Make it first: threads that are there already would take the signals."""

    def __init__(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, [order.value for order in Order])

    def wait(self, seconds: float) -> Order | None:
        """Return the next order, or None after so long."""
        found = signal.sigtimedwait([order.value for order in Order], max(seconds, 0.0))
        return None if found is None else Order(found.si_signo)

    def wait_until(self, at_s: float) -> None:
        """Return at a monotonic second; orders before that are not for now."""
        while (left_s := at_s - time.monotonic()) > 0:
            self.wait(left_s)

    def wait_for(self, order: Order) -> None:
        """Return when it comes; another order before that is not for now."""
        while self.wait(_LONG_S) is not order:
            continue

    def wait_for_the_end(self) -> NoReturn:
        """Do whatever threads do until killed."""
        while True:
            self.wait(_LONG_S)


def say(event: str, **fields: object) -> None:
    """Write one line of JSON."""
    line = memoryview(json.dumps({"event": event, **fields}).encode() + b"\n")
    while line:
        line = line[os.write(_STDOUT, line) :]
