"""Neighbour table: the neighbours at all ports of a node, and what has changed about them since it was read."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.control.hello_port import HelloPort
from gdp.control.neighbour import TRANSITIONS, Neighbour, NeighbourEvent, NeighbourState
from gdp.errors import DropReason, StatementError
from gdp.names import Name

NEIGHBOURS_MAX: Final = 64  # on one port
CANDIDATES_MAX: Final = 32  # on one port, that have not echoed our nonce; the one silent for longest is evicted
_NOTHING: Final[Mapping[int, frozenset[bytes]]] = MappingProxyType({})

# A neighbour after the change, and its state before; the same state if only the link to it changed, MTU or cost.
Change = tuple[Neighbour, NeighbourState]


class NeighbourTable:
    """Neighbours of one node; ``ports``: by index, with the neighbours and candidates of each."""

    def __init__(self) -> None:
        self.ports: dict[int, HelloPort] = {}
        self._has_moved = False  # there is a new address
        self._recosted: list[Neighbour] = []  # not polled yet
        self._reported_addresses: dict[int, frozenset[bytes]] = {}

    def get(self, port: int, name: Name) -> Neighbour | None:
        """Return the neighbour of that name that is up on a port, or None."""
        on = self.ports.get(port)
        found = on.neighbours.get(name) if on is not None else None
        return found if found is not None and found.state is NeighbourState.UP else None

    def neighbour_at(self, index: int, mac: bytes, *, is_up: bool = False) -> Neighbour | None:
        """Return the neighbour with an address at a port, as ``HelloPort.neighbour_at``."""
        port = self.ports.get(index)
        return None if port is None else port.neighbour_at(mac, is_up=is_up)

    def all_up(self) -> list[Neighbour]:
        """Return every neighbour that is up."""
        return [n for port in self.ports.values() for n in port.neighbours.values() if n.state is NeighbourState.UP]

    def cheapest(self, name: Name) -> Neighbour | None:
        """Return the neighbour of this name over the cheapest link, or None."""
        found = [n for port in self.ports if (n := self.get(port, name)) is not None]
        return min(found, key=lambda n: (n.cost, n.port), default=None)

    def over_link(self, name: Name, key: int) -> Neighbour | None:
        """Return the neighbour of this name over the link with this key (``link_key``), or None."""
        for index, port in self.ports.items():
            found = self.get(index, name)
            if found is not None and port.link_key(found) == key:
                return found
        return None

    def hop(self, port: int, mac: bytes) -> tuple[int, bytes]:
        """Return the hop to an address on a port: the port, that address, and our own on it."""
        return port, mac + self.ports[port].mac

    def mtu_of(self, port: int) -> int:
        """Return a port's MTU in bytes after the Ethernet header."""
        return self.ports[port].mtu

    def own_macs(self) -> dict[int, bytes]:
        """Return our own address on each port that is up."""
        return {index: port.mac for index, port in self.ports.items() if port.is_up}

    def sessions_with(self, port: int, name: Name) -> tuple[bytes, bytes] | None:
        """Return our port's nonce and a neighbour's echo, of their present sessions; None when it is not up."""
        neighbour = self.get(port, name)
        return None if neighbour is None else (self.ports[port].nonce, neighbour.echo)

    def loss_between(self, port: int, name: Name) -> float:
        """Return the larger loss of keepalives to and from a neighbour, 0 to 1; 0 also if it is not up."""
        neighbour = self.get(port, name)
        session = None if neighbour is None else neighbour.keepalives
        return 0.0 if session is None else max(session.quality.loss_in, session.quality.loss_out)

    def rtt_to(self, name: Name) -> float:
        """Return the smoothed round trip of the link to a neighbour in seconds; 0: not measured, or it is not up."""
        neighbour = self.cheapest(name)
        session = None if neighbour is None else neighbour.keepalives
        return 0.0 if session is None else session.quality.rtt.srtt_s or 0.0

    def observed_at(self, index: int, name: Name) -> Endpoint | None:
        """Return the endpoint that this end reports to a neighbour on a tunnel's port, or None."""
        port = self.ports.get(index)
        return None if port is None else port.observed.get(name)

    def observed_addresses(self) -> dict[tuple[int, Name], Endpoint]:
        """Return our own endpoints as neighbours that are up see them, by port and neighbour."""
        return {(n.port, n.name): n.observed for n in self.all_up() if n.observed is not None}

    def note_address(self, port: HelloPort, mac: bytes) -> None:
        """Note the address of a proven neighbour on a port."""
        self._has_moved = port.note_address(mac) or self._has_moved

    def poll_addresses(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""
        if not self._has_moved:
            return _NOTHING
        self._has_moved = False
        changed = {}
        for index, port in self.ports.items():
            macs = frozenset(port.addresses)
            if macs != self._reported_addresses.get(index, frozenset()):
                changed[index] = self._reported_addresses[index] = macs
        return changed

    def note_cost(self, neighbour: Neighbour) -> None:
        """Take over the measured cost of the link to a neighbour, which has changed."""
        neighbour.cost = self.ports[neighbour.port].cost_to(neighbour.name)
        self._recosted.append(neighbour)

    def poll_costs(self) -> list[Change]:
        """Return, once, the neighbours that are up and to which the measured cost has changed."""
        if not self._recosted:
            return []
        recosted, self._recosted = self._recosted, []
        return [(each, each.state) for each in recosted if each.state is NeighbourState.UP]

    def free_space(self, port: HelloPort, known: Neighbour | None, *, is_two_way: bool) -> None:
        """Ensure that an entry is free: neighbours keep theirs, the oldest candidate is evicted for the next one.

        Raises:
            StatementError: QUOTA, there are too many neighbours.
        """
        if known is not None and (known.is_proven or not is_two_way):
            return
        candidates = port.candidates()
        if is_two_way:
            if len(port.neighbours) - len(candidates) >= NEIGHBOURS_MAX:
                raise StatementError(DropReason.QUOTA, "neighbours on one port")
        elif len(candidates) >= CANDIDATES_MAX:
            oldest = min(candidates, key=lambda each: each.heard_s)
            del port.neighbours[oldest.name], port.said_mtus[oldest.name]

    def remove_port(self, index: int) -> None:
        """Forget a port that is down; does nothing if no port has this index."""
        self.ports.pop(index, None)
        self._reported_addresses.pop(index, None)

    @staticmethod
    def remove(port: HelloPort, lost: list[Neighbour], event: NeighbourEvent) -> list[Change]:
        """Remove neighbours from a port; return what that changed."""
        for neighbour in lost:
            del port.neighbours[neighbour.name], port.said_mtus[neighbour.name]
            port.observed.pop(neighbour.name, None)
            port.end(neighbour)
        return [change for neighbour in lost if (change := NeighbourTable.step(neighbour, event)) is not None]

    @staticmethod
    def step(neighbour: Neighbour, event: NeighbourEvent) -> Change | None:
        """Take a step of a neighbour's state machine; return what that changed."""
        before = neighbour.state
        neighbour.state = TRANSITIONS[before, event]
        return None if neighbour.state is before else (neighbour, before)
