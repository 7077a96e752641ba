"""Outbox of a switch: the frames to send, collected until the I/O layer takes them.

Sans-I/O.
"""

from __future__ import annotations

from gdp.control.fragments import ControlFragmenter
from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_table import NeighbourTable
from gdp.names import Name
from gdp.sansio import OutgoingFrames
from gdp.switch.table import Hop, ProtectedHop

__all__ = ["Outbox"]


class Outbox:
    """Collects frames, and maps neighbours to ports and addresses."""

    def __init__(self, neighbours: NeighbourTable, fragmenter: ControlFragmenter) -> None:
        self._neighbours = neighbours
        self._fragmenter = fragmenter
        self._waiting: list[OutgoingFrames] = []

    def send_to_neighbour(self, neighbour: Neighbour, kind: int, statement: bytes) -> None:
        """Send a statement to a neighbour itself."""
        self.say_at(neighbour.port, neighbour.mac, kind, statement)

    def say_at(self, port: int, mac: bytes, kind: int, statement: bytes) -> None:
        """Send a statement to the node with this address on a port."""
        if port in self._neighbours.ports:
            self.frames(port, mac, self.frames_of(port, kind, statement))

    def frames_of(self, port: int, kind: int, statement: bytes) -> list[bytes]:
        """Return the frames of a statement to a neighbour on a port."""
        return self._fragmenter.split(kind, statement, self.mtu_of(port))

    def remote_frames(self, kind: int, statement: bytes, destination: Name) -> list[bytes]:
        """Return the frames of a statement that goes beyond a neighbour."""
        mtu = min((port.mtu for port in self._neighbours.ports.values()), default=1_500)
        return self._fragmenter.split(kind, statement, mtu, destination)

    def frames(self, port: int, mac: bytes, frames: list[bytes]) -> None:
        """Send frames that are encoded already."""
        self._waiting.append(OutgoingFrames(port, mac, frames))

    def put(self, transmit: OutgoingFrames) -> None:
        """Add outgoing frames."""
        self._waiting.append(transmit)

    def hop(self, neighbour: Neighbour) -> Hop:
        """Return the table's hop to a neighbour."""
        return neighbour.port, neighbour.mac + self._neighbours.ports[neighbour.port].mac

    def protected_hop(self, neighbour: Neighbour, alternate: Name | None) -> Hop | ProtectedHop:
        """Return the hop to a neighbour with an alternate: over a second link to it, or else through ``alternate``."""
        hop = self.hop(neighbour)
        others = [port for port in self._neighbours.ports if port != hop[0]]
        for name in (neighbour.name, alternate or neighbour.name):
            found = [n for port in others if (n := self._neighbours.get(port, name)) is not None]
            if found:
                return *hop, *self.hop(min(found, key=lambda n: (n.cost, n.port)))
        return hop

    def hop_at(self, port: int, mac: bytes) -> Hop:
        """Return the table's hop to an address on a port."""
        return port, mac + self._neighbours.ports[port].mac

    def mac_of(self) -> dict[int, bytes]:
        """Return our own address on each port that is up."""
        return {index: port.mac for index, port in self._neighbours.ports.items() if port.is_up}

    def mtu_of(self, port: int) -> int:
        """Return a port's MTU in bytes after the Ethernet header."""
        return self._neighbours.ports[port].mtu

    def poll_frames(self) -> list[OutgoingFrames]:
        """Return, once, the frames to send."""
        waiting, self._waiting = self._waiting, []
        return waiting
