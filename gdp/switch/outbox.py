"""Outbox of a switch: the frames to send, collected until the I/O layer takes them, and statements made into frames."""

from __future__ import annotations

from gdp.control.fragments import ControlFragmenter
from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_table import NeighbourTable
from gdp.sansio import OutgoingFrames


class Outbox:
    """Frames that a switch has to send.

    Attributes:
        waiting: those to send next; each part of the switch appends its own.
        fragmenter: of the switch's statements.
    """

    def __init__(self, neighbours: NeighbourTable, fragmenter: ControlFragmenter) -> None:
        self._neighbours = neighbours
        self.fragmenter = fragmenter
        self.waiting: list[OutgoingFrames] = []

    def send_to_neighbour(self, neighbour: Neighbour, kind: int, statement: bytes) -> None:
        """Send a statement to a neighbour itself."""
        self.say_at(neighbour.port, neighbour.mac, kind, statement)

    def say_at(self, port: int, mac: bytes, kind: int, statement: bytes) -> None:
        """Send a statement to the node with this address on a port."""
        if port in self._neighbours.ports:
            self.waiting.append(OutgoingFrames(port, mac, self.frames_of(port, kind, statement)))

    def frames_of(self, port: int, kind: int, statement: bytes) -> list[bytes]:
        """Return the frames of a statement to a neighbour on a port."""
        return self.fragmenter.split(kind, statement, self._neighbours.ports[port].mtu)

    def poll_frames(self) -> list[OutgoingFrames]:
        """Return, once, the frames to send."""
        waiting, self.waiting = self.waiting, []
        return waiting
