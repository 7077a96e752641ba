"""What the roles of a live ring want of a ROS node, whichever ROS it is.

Place: pure; ``ros1`` and ``ros2`` do the I/O.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

__all__ = ["Call", "Caller", "Lamp", "Node", "Publisher"]


@dataclass(frozen=True, slots=True)
class Call:
    """A lamp's answer. ``size``: bytes of request and response, as this ROS writes them."""

    success: bool
    message: str
    size: int


class Publisher(Protocol):
    """One topic's publisher."""

    def message(self) -> object:
        """Return a new, empty message."""

    def publish(self, message: object) -> None:
        """Send it."""


class Caller(Protocol):
    """A client of a lamp."""

    def wait(self, seconds: float) -> bool:
        """Return whether the service is there by then."""

    def call(self, *, on: bool, patience_s: float) -> Call | None:
        """Switch it; return the answer, None if none came."""


Lamp = Callable[[bool], tuple[bool, str]]  # on -> success, message


class Node(Protocol):
    """A node at work: callbacks come from threads of its own."""

    def publisher(self, topic: str, type_name: str, *, latched: bool) -> Publisher:
        """Publish a topic."""

    def subscribe(self, topic: str, type_name: str, take: Callable[[object], None], *, latched: bool) -> None:
        """Hear a topic."""

    def serve(self, name: str, type_name: str, lamp: Lamp) -> None:
        """Serve a ``SetBool``."""

    def caller(self, name: str, type_name: str) -> Caller:
        """Be a client of a ``SetBool``."""

    def fit(self, values: array[int]) -> object:
        """Return an array as this ROS takes it in a message."""

    def size(self, message: object) -> int:
        """Return the bytes of a message as this ROS writes it."""
