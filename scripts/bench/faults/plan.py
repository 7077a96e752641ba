"""Plan of a network under test, as data: switches, RIBs, members, and their flows and services.

Sans-I/O. A member is a node of the topology without a switch of its own, joined to its home switch by one link. That
link may be moved to the other switches it lists.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from gdp.simulation.topology import Attachment, DomainPlan, Link, Topology

__all__ = ["Churn", "Flow", "Plan", "Service", "ends_of", "make_topology"]

RIB_IFNAME = "rib"


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
class Churn:
    """Topic that a member reads (or publishes) at intervals: it starts and ends repeatedly."""

    topic: str
    member: str
    publishes: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """One run without its faults.

    Args:
        topology: members are nodes of it, too.
        members: those nodes that run no switch.
        homes: of members (and switches) whose link moves: the possible switches, the first at the start.
        flows, services: traffic between members; the index in the tuple is the channel.
        spare: flows that begin one by one, when publisher and readers get a signal; their channels come after those.
        churn: topics that come and go; a channel for each topic, that of its flow where it has one.
    """

    topology: Topology
    members: tuple[str, ...]
    homes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    flows: tuple[Flow, ...] = ()
    services: tuple[Service, ...] = ()
    spare: tuple[Flow, ...] = ()
    churn: tuple[Churn, ...] = ()

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

    def churns(self, member: str) -> Iterable[tuple[int, Churn]]:
        """Yield the churning topics of a member, with their channels."""
        topics = [flow.topic for flow in self.flows]
        after = len(self.flows) + len(self.services) + len(self.spare)
        topics += [""] * (after - len(topics))
        for each in self.churn:
            if each.topic not in topics:
                topics.append(each.topic)
            if each.member == member:
                yield topics.index(each.topic), each


def ends_of(link: str) -> tuple[str, str]:
    """Return the two ends of a link ``a-b``."""
    a, _, b = link.partition("-")
    return a, b


def make_topology(
    domains: Mapping[str, Iterable[str]],
    uppers: Mapping[str, str],
    links: Iterable[str | Link],
    ribs: Iterable[str],
    members: Mapping[str, str],
) -> tuple[Topology, tuple[str, ...]]:
    """Return a topology, and its members.

    Args:
        domains: switches by label.
        uppers: the domain of the tier above, by label.
        links: between switches, ``a-b`` at the usual cost.
        ribs: switches with a RIB, in the order of the topology's attachments.
        members: home switch by member; a member is of its home's domain.

    Raises:
        LocalError: they do not fit together.
    """
    of = {switch: label for label, switches in domains.items() for switch in switches}
    plans = tuple(
        DomainPlan(label, (*switches, *(m for m, home in members.items() if of[home] == label)), uppers.get(label))
        for label, switches in domains.items()
    )
    made = [Link(*ends_of(each)) if isinstance(each, str) else each for each in links]
    leads = [Link(member, home) for member, home in members.items()]
    attachments = (
        *(Attachment(switch, "rib", RIB_IFNAME) for switch in ribs),
        *(Attachment(member, "proxy", "end") for member in members),
    )
    return Topology((*made, *leads), plans, attachments), tuple(members)
