"""What a switch has to send, gathered until its shell takes it.

Place: pure.
"""

from __future__ import annotations

from gdp.control.frames import ControlSplitter
from gdp.control.greeter import Greeter
from gdp.control.neighbour import Neighbour
from gdp.effects import Transmit
from gdp.names import Name
from gdp.switch.table import Hop, ProtectedHop

__all__ = ["Outbox"]


class Outbox:
    """Collects frames, and knows how neighbours are reached."""

    def __init__(self, greeter: Greeter, splitter: ControlSplitter) -> None:
        self._greeter = greeter
        self._splitter = splitter
        self._waiting: list[Transmit] = []

    def say(self, neighbour: Neighbour, kind: int, statement: bytes) -> None:
        """Send a statement to a neighbour itself."""
        self.say_at(neighbour.port, neighbour.mac, kind, statement)

    def say_at(self, port: int, mac: bytes, kind: int, statement: bytes) -> None:
        """Send a statement to whoever has this address on a port."""
        if port in self._greeter.ports:
            frames = self._splitter.split(kind, statement, self._greeter.ports[port].mtu)
            self._waiting.append(Transmit(port, mac, frames))

    def far(self, kind: int, statement: bytes, destination: Name) -> list[bytes]:
        """Return the frames of a statement that goes further than a neighbour."""
        mtu = min((port.mtu for port in self._greeter.ports.values()), default=1_500)
        return self._splitter.split(kind, statement, mtu, destination)

    def frames(self, port: int, mac: bytes, frames: list[bytes]) -> None:
        """Send frames that are ready."""
        self._waiting.append(Transmit(port, mac, frames))

    def put(self, transmit: Transmit) -> None:
        """Send what is ready to go."""
        self._waiting.append(transmit)

    def neighbour(self, name: Name) -> Neighbour | None:
        """Return the neighbour of this name over the cheapest port, or None."""
        found = [n for port in self._greeter.ports if (n := self._greeter.neighbour(port, name)) is not None]
        return min(found, key=lambda n: (self._greeter.ports[n.port].cost, n.port), default=None)

    def sessions_with(self, port: int, name: Name) -> tuple[bytes, bytes] | None:
        """Return our port's nonce and a neighbour's echo, of their present sessions; None when it is not up."""
        neighbour = self._greeter.neighbour(port, name)
        return None if neighbour is None else (self._greeter.ports[port].nonce, neighbour.echo)

    def hop(self, neighbour: Neighbour) -> Hop:
        """Return the table's hop to a neighbour."""
        return neighbour.port, neighbour.mac + self._greeter.ports[neighbour.port].mac

    def protected_hop(self, neighbour: Neighbour, alternate: Name | None) -> Hop | ProtectedHop:
        """Return the hop to a neighbour with another way out: over a second link to it, or else to ``alternate``."""
        hop = self.hop(neighbour)
        others = [port for port in self._greeter.ports if port != hop[0]]
        for name in (neighbour.name, alternate or neighbour.name):
            found = [n for port in others if (n := self._greeter.neighbour(port, name)) is not None]
            if found:
                return *hop, *self.hop(min(found, key=lambda n: (self._greeter.ports[n.port].cost, n.port)))
        return hop

    def hop_at(self, port: int, mac: bytes) -> Hop:
        """Return the table's hop to an address on a port."""
        return port, mac + self._greeter.ports[port].mac

    def mac_of(self) -> dict[int, bytes]:
        """Return our own address on each port that is up."""
        return {index: port.mac for index, port in self._greeter.ports.items() if port.is_up}

    def mtu_of(self, port: int) -> int:
        """Return a port's MTU in bytes after the Ethernet header."""
        return self._greeter.ports[port].mtu

    def take(self) -> list[Transmit]:
        """Return, once, what waits."""
        waiting, self._waiting = self._waiting, []
        return waiting
