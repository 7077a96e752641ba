"""Node interface that the roles of a live ring need, for either ROS, and the orders that they take by signals. I/O."""

from __future__ import annotations

import json
import os
import signal
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from typing import Final, NoReturn, Protocol


@dataclass(frozen=True, slots=True)
class Call:
    """A lamp's reply. ``size``: bytes of request and response in this ROS's wire form."""

    success: bool
    message: str
    size: int


class Caller(Protocol):
    """A client of a lamp."""

    def wait(self, seconds: float) -> bool:
        """Return whether the service is available within this many seconds."""

    def call(self, *, on: bool, patience_s: float) -> Call | None:
        """Call the lamp; return the reply, None if none came within ``patience_s`` seconds."""


Lamp = Callable[[bool], tuple[bool, str]]  # on -> success, message


class Node(Protocol):
    """A running node: its callbacks come from threads of its own."""

    def publisher(self, topic: str, type_name: str, *, latched: bool) -> Callable[[object], None]:
        """Create a publisher of a topic; return what publishes a message."""

    def subscribe(self, topic: str, type_name: str, take: Callable[[object], None], *, latched: bool) -> None:
        """Subscribe to a topic."""

    def serve(self, name: str, type_name: str, lamp: Lamp) -> None:
        """Create a ``SetBool`` server."""

    def caller(self, name: str, type_name: str) -> Caller:
        """Create a ``SetBool`` client."""

    def fit(self, values: array[int]) -> object:
        """Return an array in the form of this ROS's messages."""

    def size(self, message: object) -> int:
        """Return the bytes of a message in this ROS's wire form."""


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
