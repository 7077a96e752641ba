"""What a thinking machine is given, and what it asks its shell to do.

Place: ground floor; pure. A machine holds no socket and no clock: a shell feeds it arrivals and the time, and takes out
frames to send and the moment at which it wants to be called again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, Protocol

__all__ = ["BROADCAST", "OutgoingFrames", "ProtocolCore", "ReceivedFrame", "Timestamps"]

BROADCAST: Final = b"\xff" * 6


class Timestamps(NamedTuple):
    """One moment on two clocks."""

    mono_s: float  # monotonic: leases and timers
    unix_s: float  # wall clock: validity of certificates only


class ReceivedFrame(NamedTuple):
    """A frame that was handed up."""

    port: int
    mac: bytes  # the sender's, 6 bytes
    frame: bytes  # from the header on, without the Ethernet header; may end in padding
    waited_s: float = 0.0  # between its arrival and the moment at which it is handed up, where that is known

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
    """A switch, a RIB or a member of the overlay, as a shell or a simulated network drives it."""

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Begin to use a port.

        Args:
            mtu: bytes after the Ethernet header.
        """

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Take frames in; never raises for what they contain."""

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Learn that a port's link came or went."""

    def handle_timer(self, now: Timestamps) -> None:
        """Do what is due; harmless when nothing is."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""

    def frames_to_send(self) -> list[OutgoingFrames]:
        """Return, once, what is to be sent; more may come at the next call, until nothing does."""
