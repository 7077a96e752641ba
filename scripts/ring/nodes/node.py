"""Node interface that the roles of a live ring need, for either ROS.

Sans-I/O; ``ros1`` and ``ros2`` do the I/O.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Call:
    """A lamp's reply. ``size``: bytes of request and response in this ROS's wire form."""

    success: bool
    message: str
    size: int


class Publisher(Protocol):
    """One topic's publisher."""

    def message(self) -> object:
        """Return a new, empty message."""

    def publish(self, message: object) -> None:
        """Publish a message."""


class Caller(Protocol):
    """A client of a lamp."""

    def wait(self, seconds: float) -> bool:
        """Return whether the service is available within this many seconds."""

    def call(self, *, on: bool, patience_s: float) -> Call | None:
        """Call the lamp; return the reply, None if none came within ``patience_s`` seconds."""


Lamp = Callable[[bool], tuple[bool, str]]  # on -> success, message


class Node(Protocol):
    """A running node: its callbacks come from threads of its own."""

    def publisher(self, topic: str, type_name: str, *, latched: bool) -> Publisher:
        """Create a publisher of a topic."""

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
