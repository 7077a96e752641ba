"""Interface of the systems that carry the traffic of the uplink bench, and their common settings.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from thin_link.traffic import Stream

Arrival = Callable[[Stream, bytes, int], None]  # stream, message, monotonic ns; any thread


class Carrier(Protocol):
    """One end of a system."""

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        """Publish a stream; return what sends a message, which may wait."""

    def subscribe(self, stream: Stream) -> None:
        """Read a stream from now on."""

    def is_matched(self) -> bool:
        """Return whether every published stream is read."""
