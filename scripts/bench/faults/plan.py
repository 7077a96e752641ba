"""Plan of a network under test, as data: switches, RIBs, members, and their flows and services.

Sans-I/O. A member is a node of the topology without a switch of its own, joined to its home switch by one link. That
link may be moved to the other switches it lists.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from lab.topology import Topology


@dataclass(frozen=True, slots=True)
class Flow:
    """Topic with one publisher; ``size``: bytes of each message."""

    topic: str
    publisher: str
    readers: tuple[str, ...]
    reliable: bool = True
    hz: float = 20.0
    size: int = 100


@dataclass(frozen=True, slots=True)
class Service:
    """Service with its replicas and its clients."""

    name: str
    servers: tuple[str, ...]
    clients: tuple[str, ...]
    hz: float = 5.0
    timeout_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Plan:
    """One run without its faults.

    Args:
        topology: members are nodes of it, too.
        members: those nodes that run no switch.
        homes: of members (and switches) whose link moves: the possible switches, the first at the start.
        flows, services: traffic between members; the index in the tuple is the channel.
        spare: flows that begin one by one, when publisher and readers get a signal; their channels come after those.
    """

    topology: Topology
    members: tuple[str, ...]
    homes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    flows: tuple[Flow, ...] = ()
    services: tuple[Service, ...] = ()
    spare: tuple[Flow, ...] = ()

    @property
    def switches(self) -> tuple[str, ...]:
        """Return the nodes that run a switch."""
        return tuple(node for node in self.topology.nodes if node not in self.members)

    @property
    def ribs(self) -> tuple[str, ...]:
        """Return the switches that a RIB is attached to."""
        return tuple(at.switch for at in self.topology.attached("rib"))

    def home(self, mover: str) -> str:
        """Return the switch into which a member, or a switch that moves, is plugged at the start."""
        homes = self.homes.get(mover)
        return homes[0] if homes else next(self.topology.links_of(mover)).other(mover)

    def channels(self, member: str) -> Iterable[tuple[int, Flow | Service]]:
        """Yield what a member takes part in, with its channel."""
        for channel, flow in enumerate(self.flows):
            if member == flow.publisher or member in flow.readers:
                yield channel, flow
        for channel, service in enumerate(self.services, len(self.flows)):
            if member in service.servers or member in service.clients:
                yield channel, service

    def spares(self, member: str) -> Iterable[tuple[int, Flow]]:
        """Yield the spare flows that a member has a part in, with their channels."""
        for channel, flow in enumerate(self.spare, len(self.flows) + len(self.services)):
            if member == flow.publisher or member in flow.readers:
                yield channel, flow
