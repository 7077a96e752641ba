"""State of a running node: who it is, its ports and neighbours, what it dropped and what it waits for.

Sans-I/O. A node has one such object over its core and its plane, and reads nothing twice from them: tables, status,
snapshots, facts, metrics and logs are projections of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from gdp.control.boundary import ErrorBoundary
from gdp.control.diagnostics import Diagnostics
from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.waiting import Wait, wait_fact
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.errors import DropReason
from gdp.message.clock_offset import ClockEstimate
from gdp.names import Name
from gdp.ports.plane import Plane
from gdp.sansio import Timestamps
from gdp.telemetry.sources import DeviceCounts, NeighbourRow, PortRow
from gdp.trust.domain import Policy

if TYPE_CHECKING:  # a node loads its own core alone, which makes the start of a library short
    from gdp.client.attachment import Attachment
    from gdp.client.participant import Participant
    from gdp.client.rib_host import RibHost
    from gdp.diagnosis.facts import WaitFact
    from gdp.switch.core import SwitchCore


class Core(Protocol):
    """What every protocol core has."""

    diagnostics: Diagnostics
    boundary: ErrorBoundary

    def drops(self) -> Mapping[DropReason, int]:
        """Return what the core dropped, by reason."""


class NodeState(ABC):
    """State of one node.

    Args:
        begun_s: monotonic second of its start.

    Attributes:
        role: word for the kind of node in errors.
        clocks: of members, as of the last ``refresh``; any thread may read them.
        links: neighbours that are up, as of the last ``refresh``, by port and short name; any thread may read them.
        read_devices: returns counts by device, as ``PortCounters.read``.
        local_name: returns the user's word for a name, or another form for people.
    """

    role = "node"

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        plane: Plane,
        hello_protocol: HelloProtocol,
        core: Core,
        begun_s: float,
    ) -> None:
        self.identity = identity
        self.policy = policy
        self.plane = plane
        self.hello_protocol = hello_protocol
        self.core = core
        self.begun_s = begun_s
        self.links: list[NeighbourRow] = []
        self.clocks: list[tuple[Membership, ClockEstimate]] = []
        self.read_devices: Callable[[], Mapping[str, Sequence[int]]] = dict
        self.local_name: Callable[[Name], str] = lambda name: name.short

    @abstractmethod
    def waits(self, now_s: float) -> list[Wait]:
        """Return what the node waits for at a monotonic second."""

    @property
    @abstractmethod
    def own_switch(self) -> Name | None:
        """Return the switch that the node is attached to, or None; a switch returns its own name."""

    @property
    def conflict_at(self) -> Name | None:
        """Return the switch that refused another node with this identity; None: there was none."""
        return None

    def devices(self) -> dict[str, DeviceCounts]:
        """Return what the kernel counted at each device; any thread may ask."""
        return {device: DeviceCounts(*counts) for device, counts in self.read_devices().items()}

    def ports(self) -> list[PortRow]:
        """Return the ports by device; one whose device is absent has no counts. Any thread may ask."""
        devices = self.devices()
        rows = [
            PortRow(port.ifname, port.up, port.mtu, devices.get(port.ifname))
            for port in list(self.plane.ports.values())
        ]
        return sorted(rows, key=lambda row: row.port)

    def refresh(self, now: Timestamps) -> None:
        """Read links and clocks again; the node's own thread calls it."""
        self.clocks = self.core.diagnostics.clocks(now)
        self.links = sorted(self.neighbours(is_up=True), key=lambda row: (row.port, row.name.short))

    def neighbours(self, *, is_up: bool = False) -> Iterator[NeighbourRow]:
        """Yield the neighbours by port and address, or those alone that are up."""
        for index in sorted(self.hello_protocol.ports):
            for _, each in sorted(self.hello_protocol.ports[index].neighbours.items()):
                if each.state is NeighbourState.UP or not is_up:
                    yield self._row(each)

    def drops(self) -> Mapping[DropReason, int]:
        """Return what plane and core dropped, by reason."""
        plane = {reason: self.plane.counters.drops[reason] for reason in DropReason}
        return Counter(plane) + Counter(self.core.drops())

    def ifname(self, index: int) -> str:
        """Return the device of a port; of a port that is gone its number."""
        port = self.plane.ports.get(index)
        return str(index) if port is None else port.ifname

    def domain_label(self, domain: Name) -> str:
        """Return the label of a trusted domain; of another one, its short name."""
        root = self.policy.roots.get(domain)
        return domain.short if root is None else root.label

    def wait_facts(self, now_s: float) -> tuple[WaitFact, ...]:
        """Return what the node waits for now, as facts of a diagnosis."""
        return tuple(wait_fact(each, "" if each.port is None else self.ifname(each.port)) for each in self.waits(now_s))

    def uptime_s(self, now_s: float) -> float:
        """Return the seconds since the start, to a tenth."""
        return round(max(now_s - self.begun_s, 0.0), 1)

    def _row(self, neighbour: Neighbour) -> NeighbourRow:
        quality = self.hello_protocol.ports[neighbour.port].quality_of(neighbour.name)
        return NeighbourRow(
            port=self.ifname(neighbour.port),
            name=neighbour.name,
            label="" if neighbour.member is None else neighbour.member.label,
            role=neighbour.role.value,
            domain=neighbour.domain,
            state=neighbour.state.name.lower(),
            mac=neighbour.mac,
            mtu=neighbour.mtu,
            cost=neighbour.cost,
            rtt_s=quality.rtt.srtt_s,
            rtt_var_s=quality.rtt.rttvar_s,
            loss_in=quality.loss_in,
            loss_out=quality.loss_out,
        )


class SwitchState(NodeState):
    """State of a switch; ``unwaited``: returns the ports for whose neighbours it does not wait."""

    role = "switch"

    def __init__(self, identity: Identity, policy: Policy, plane: Plane, switch: SwitchCore, begun_s: float) -> None:
        super().__init__(identity, policy, plane, switch.hello_protocol, switch, begun_s)
        self.switch = switch
        self.unwaited: Callable[[], Collection[int]] = frozenset

    def waits(self, now_s: float) -> list[Wait]:
        """Return what the switch waits for at a monotonic second."""
        return self.switch.waits(self.unwaited(), now_s)

    @property
    def own_switch(self) -> Name:
        """Return its own name."""
        return self.switch.name


class AttachedState(NodeState):
    """State of a node that is attached to a switch."""

    def __init__(
        self, identity: Identity, policy: Policy, plane: Plane, attachment: Attachment, core: Core, begun_s: float
    ) -> None:
        super().__init__(identity, policy, plane, attachment.hello_protocol, core, begun_s)
        self.attachment = attachment

    def waits(self, now_s: float) -> list[Wait]:
        """Return what keeps it from being attached with all that it advertises, at a monotonic second."""
        from gdp.client.attachment import attachment_waits

        return attachment_waits(self.attachment, now_s)

    @property
    def own_switch(self) -> Name | None:
        """Return the switch that it is attached to, or None."""
        return None if self.attachment.switch is None else self.attachment.switch.name

    @property
    def conflict_at(self) -> Name | None:
        """Return the switch that refused another node with this identity; None: there was none."""
        return self.attachment.conflict_at


class RibState(AttachedState):
    """State of a RIB."""

    role = "RIB"

    def __init__(self, identity: Identity, policy: Policy, plane: Plane, host: RibHost, begun_s: float) -> None:
        super().__init__(identity, policy, plane, host.attachment, host, begun_s)
        self.host = host

    def waits(self, now_s: float) -> list[Wait]:
        """Return what the RIB waits for at a monotonic second."""
        return [*super().waits(now_s), *self.host.rib.waits(now_s)]


class MemberState(AttachedState):
    """State of a proxy or of a session's node."""

    role = "proxy"

    def __init__(self, identity: Identity, policy: Policy, plane: Plane, member: Participant, begun_s: float) -> None:
        super().__init__(identity, policy, plane, member.attachment, member, begun_s)
        self.member = member
