"""What the nodes of a live ring need in either ROS: types, orders by signals, and lines of JSON. I/O."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from typing import Final, NoReturn


@dataclass(frozen=True, slots=True)
class Call:
    """A lamp's reply. ``size``: bytes of request and response in this ROS's wire form."""

    success: bool
    message: str
    size: int


Lamp = Callable[[bool], tuple[bool, str]]  # on -> success, message


def load_type(type_name: str) -> Callable[..., object]:
    """Return the class of a type of messages or services, such as ``std_msgs/msg/String``, of this process's ROS."""
    package, kind, name = type_name.split("/")
    found: Callable[..., object] = getattr(import_module(f"{package}.{kind}"), name)
    return found


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
