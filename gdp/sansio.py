"""Sans-I/O interface: what a protocol core receives from its I/O layer, and what it returns.

Sans-I/O. Source: sans-io.readthedocs.io. A protocol core holds no socket and no clock. An I/O layer passes it received
frames and the time, and takes out frames to send and the time of the next call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, Protocol

__all__ = ["BROADCAST", "OutgoingFrames", "ProtocolCore", "ReceivedFrame", "Timestamps", "new_tuple"]

BROADCAST: Final = b"\xff" * 6
new_tuple: Final = tuple.__new__  # of a named tuple: one call, where its constructor is two and ``_make`` three


class Timestamps(NamedTuple):
    """One moment on two clocks."""

    mono_s: float  # monotonic: leases and timers
    unix_s: float  # wall clock: validity of certificates only


class ReceivedFrame(NamedTuple):
    """A frame that was punted to the protocol core."""

    port: int
    mac: bytes  # the sender's, 6 bytes
    frame: bytes  # from the header on, without the Ethernet header; may end in padding
    waited_s: float = 0.0  # seconds between its arrival and its processing, if known

    @property
    def via(self) -> bytes:
        """Return port and sender's address as one key."""
        return self.port.to_bytes(4, "big") + self.mac


class OutgoingFrames(NamedTuple):
    """Frames to one neighbour, in order."""

    port: int
    mac: bytes  # the receiver's, 6 bytes
    frames: Sequence[bytes]  # each from the header on


class ProtocolCore(Protocol):
    """A switch, a RIB or a participant, as an I/O layer or a simulated network drives it."""

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Begin to use a port.

        Args:
            mtu: bytes after the Ethernet header.
            cost: of its links; ``COST_AUTO``: measured.
        """

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        """Learn how to count the frames that have come from a port, those too that a data plane keeps from the core."""

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Process received frames; never raises for what they contain."""

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Update the state of a port's link."""

    def handle_timer(self, now: Timestamps) -> None:
        """Process the timers that are due; harmless when none is."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        """Return, once, the frames to send; call again until it returns none."""

    def frames_sent(self, now_s: float) -> None:
        """Note that the frames returned last are sent now: preparing them took time."""
