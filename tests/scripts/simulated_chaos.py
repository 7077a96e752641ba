"""Chaos run in virtual time: the network, the faults and the accounts of the bench, on simulated links.

Sans-I/O. A seed repeats the whole run, frame by frame, so what broke can be followed. Links between switches may be
thin, with a FIFO. There are no processes, disks and clocks here, so faults of these are not injected; calls are not
made.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Final

from faults.accounts import Books, Continuity
from faults.plan import Flow, Plan
from faults.records import Kind, Record

from gdp.client.participant import Participant
from gdp.client.publisher import Publisher
from gdp.client.send_options import DEFAULT_OPTIONS, SendOptions
from gdp.intervals import SCAPY_KEEPALIVE_MS
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.trust.right import Right
from lab.faults import Fault, FaultKind, broken_by, links_of
from lab.network import SimLink
from lab.process import FailedError
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Topology

__all__ = ["SIMULATED", "SimulatedChaos"]

SIMULATED: Final = (
    FaultKind.CUT, FaultKind.SILENT, FaultKind.LOSS, FaultKind.REORDERED, FaultKind.KILL_SWITCH, FaultKind.KILL_RIB,
    FaultKind.KILL_MEMBER, FaultKind.FREEZE, FaultKind.PARTITION, FaultKind.ROAM,
)  # fmt: skip
JOURNAL_BYTES: Final = 64 << 20
AFTER_S: Final = 8.0  # observation after the last fault
_HEAD: Final = struct.Struct("!HHIQ")  # channel, publisher, incarnation, number
_STEP_S: Final = 0.05
_SETTLE_S: Final = 60.0
_LOSS_OF: Final = {FaultKind.SILENT: 1.0, FaultKind.LOSS: 0.05}
_JITTER_S: Final = 0.02


class SimulatedChaos:
    """One run.

    Args:
        plan: the network.
        faults: in the order of their starts, of the kinds in ``SIMULATED``.
        keepalive_ms: None: the usual one.
        seed: of keys, delays and losses.
        options: of all topics.

    Attributes:
        world: the simulated network.
        publishers: by channel; that of the last incarnation.
        begun_s: virtual second at which the first fault was scheduled from.
    """

    def __init__(
        self,
        plan: Plan,
        faults: Sequence[Fault],
        seed: int,
        keepalive_ms: int | None = SCAPY_KEEPALIVE_MS,
        options: SendOptions = DEFAULT_OPTIONS,
    ) -> None:
        self._plan, self._faults, self._options = plan, faults, options
        self.world = Simulation(
            topology=_topology(plan), seed=seed, keepalive_ms=keepalive_ms, journal_bytes=JOURNAL_BYTES
        )
        self._labels = {label.rpartition("/")[2]: label for label in self.world.members}
        self._at = {mover: homes[0] for mover, homes in plan.homes.items()}
        self._incarnations: Counter[str] = Counter()
        self._dead: set[str] = set()
        self._numbers: Counter[tuple[int, int]] = Counter()  # by channel and incarnation of the publisher
        self._seen: dict[tuple[str, int], Counter[LossReason]] = {}
        self.publishers: dict[int, Publisher] = {}
        self._names: dict[int, Name] = {}
        self._under_way: list[Fault] = []
        self.books = Books(plan)
        self._continuity = Continuity(plan, self.books)
        self.begun_s = self._last_s = self._end_s = 0.0

    def settle(self, *, thin_bits_s: float = 0.0, fifo_s: float = 0.0) -> None:
        """Attach all members and return when every flow is delivered; then make the links thin, if they are to be.

        Raises:
            FailedError: not in time.
        """
        if not self.world.run_until_attached(_SETTLE_S):
            raise FailedError("before any fault, a member was not attached")
        for member in self._plan.members:
            self._begin_flows(member)
        network = self.world.network
        for channel, flow in enumerate(self._plan.flows):
            network.call(channel * 0.01, partial(self._publish, channel, flow))
        latest_s = network.now.mono_s + _SETTLE_S
        while missing := self._continuity.unreached():
            if network.now.mono_s >= latest_s:
                raise FailedError(f"before any fault, nothing came: {', '.join(missing)}")
            self._step(network.now.mono_s + _STEP_S)
        if thin_bits_s:
            for cable in self.world.cables.values():
                cable.bytes_s, cable.fifo_s = thin_bits_s / 8, fifo_s

    def run(self) -> None:
        """Apply the faults, each at its time; observe for a while after the last."""
        network = self.world.network
        self.begun_s = network.now.mono_s
        self._note()
        for fault in self._faults:
            network.call(fault.start_s, partial(self._begin, fault))
            network.call(fault.end_s, partial(self._end, fault))
        self._last_s = self.begun_s + max((fault.end_s for fault in self._faults), default=0.0)
        self._end_s = self._last_s + AFTER_S
        self._step(self._end_s)

    def broken_promises(self, limit_s: float, well_s: float) -> list[str]:
        """Return what broke, in words.

        Args:
            limit_s: longest silence of connected ends during faults.
            well_s: longest silence after the last fault.
        """
        begun_ns, last_ns, end_ns = (_ns(each) for each in (self.begun_s, self._last_s, self._end_s))
        found = self._continuity.broken_promises(begun_ns, last_ns, end_ns, limit_s, well_s)
        return [*found, *sorted(set(self.books.wrong)), *self.books.incomplete(self._is_last_life, end_ns - _ns(2.0))]

    def silences(self, above_s: float) -> list[float]:
        """Return the longer silences of connected ends from the first fault on, in seconds."""
        found = self._continuity.silences(_ns(self.begun_s), _ns(self._end_s), above_s)
        return [each.seconds for each in found]

    def _is_last_life(self, member: str, incarnation: int) -> bool:
        return incarnation == self._incarnations[member]

    def _member(self, member: str) -> Participant:
        return self.world.members[self._labels[member]]

    def _begin_flows(self, member: str) -> None:
        """Let a member publish and read, in a new incarnation."""
        self._incarnations[member] += 1
        node = self._member(member)
        for channel, flow in enumerate(self._plan.flows):
            if member == flow.publisher:
                topic = self.world.topic(flow.topic, node, [Right.PUBLISH])
                self._names[channel] = topic.name
                self.publishers[channel] = node.advertise(
                    topic, b"chaos", reliable=flow.reliable, options=self._options
                )
            elif member in flow.readers:
                node.subscribe(self.world.topic(flow.topic, node, [Right.READ]))
        self.world.network.send_pending(self._labels[member])

    def _publish(self, channel: int, flow: Flow) -> None:
        """Publish the next message of a flow, and again after its period, as long as its publisher runs."""
        network, who = self.world.network, flow.publisher
        network.call(1 / flow.hz, partial(self._publish, channel, flow))
        if who in self._dead or (self._end_s and network.now.mono_s > self._end_s):
            return
        incarnation = self._incarnations[who]
        self._numbers[channel, incarnation] += 1
        number = self._numbers[channel, incarnation]
        index = self._plan.members.index(who)
        self._record(who, Kind.PUBLISHED, channel, incarnation, index, number)
        head = _HEAD.pack(channel, index, incarnation, number)
        self.publishers[channel].publish(head + bytes(max(flow.size - _HEAD.size, 0)))
        self._member(who).flush(network.now.mono_s)
        network.send_pending(self._labels[who])

    def _step(self, until_s: float) -> None:
        network = self.world.network
        while network.now.mono_s < until_s:
            network.run(min(_STEP_S, until_s - network.now.mono_s))
            for member in self._plan.members:
                if member not in self._dead:
                    self._collect(member)

    def _collect(self, member: str) -> None:
        node, of = self._member(member), {name: channel for channel, name in self._names.items()}
        for each in node.poll_messages():
            channel, publisher, incarnation, number = _HEAD.unpack_from(each.delivered.message)
            kind = Kind.DELIVERED if of[each.topic] == channel else Kind.WRONG
            self._record(member, kind, of[each.topic], incarnation, publisher, number)
        for channel, flow in enumerate(self._plan.flows):
            if member in flow.readers:
                counts = Counter(node.subscriptions.losses_of(self._names[channel]).counts)
                seen = self._seen.get((member, channel), Counter())
                for reason, more in (counts - seen).items():
                    self._record(member, Kind.LOST, channel, 0, reason, more)
                self._seen[member, channel] = counts

    def _record(self, member: str, kind: Kind, channel: int, incarnation: int, other: int, number: int) -> None:
        record = Record(kind, channel, incarnation, other, number, _ns(self.world.network.now.mono_s))
        self.books.take(member, self._incarnations[member], iter([record]))

    def _note(self) -> None:
        """Record what must be connected from now on."""
        self._continuity.note(_ns(self.world.network.now.mono_s), broken_by(self._under_way, self._at))

    def _cable(self, *ends: str) -> SimLink:
        return self.world.cables[frozenset(ends)]

    def _set_links(self, fault: Fault, *, up: bool) -> None:
        """Cut or restore what a cut or a partition takes down."""
        for ends in links_of(fault):
            self.world.network.set_link(self._cable(*ends), up=up)

    def _node(self, who: str) -> str:
        """Return the name in the simulated network of a process, as in ``switch s1``."""
        role, _, node = who.partition(" ")
        if role == "rib":
            return f"{node}/rib"
        return self._labels[node] if role == "member" else node

    def _begin(self, fault: Fault) -> None:
        kind, targets, network = fault.kind, fault.targets, self.world.network
        self._under_way.append(fault)
        if kind in (FaultKind.CUT, FaultKind.PARTITION):
            self._set_links(fault, up=False)
        elif kind in _LOSS_OF:
            self._cable(*targets).loss = _LOSS_OF[kind]
        elif kind is FaultKind.REORDERED:
            self._cable(*targets).jitter_s = _JITTER_S
        elif kind is FaultKind.FREEZE:
            network.freeze(self._node(targets[0]))
        elif kind is FaultKind.ROAM:
            self._at[targets[0]] = targets[1]
            self.world.roam(self._labels[targets[0]], targets[1])
        else:
            if kind is FaultKind.KILL_MEMBER:
                member = targets[0].removeprefix("member ")
                self._collect(member)  # what it has confirmed reached its application
                self._dead.add(member)
            network.stop(self._node(targets[0]))
        self._note()

    def _end(self, fault: Fault) -> None:
        kind, targets, network = fault.kind, fault.targets, self.world.network
        node = targets[0].partition(" ")[2]
        if kind in (FaultKind.CUT, FaultKind.PARTITION):
            self._set_links(fault, up=True)
        elif kind in _LOSS_OF:
            self._cable(*targets).loss = 0.0
        elif kind is FaultKind.REORDERED:
            self._cable(*targets).jitter_s = 0.0
        elif kind is FaultKind.FREEZE:
            network.thaw(self._node(targets[0]))
        elif kind is FaultKind.KILL_SWITCH:
            self.world.restart_switch(node)
        elif kind is FaultKind.KILL_RIB:
            label = next(each for each in self.world.ribs if self.world.rib_node(each) == f"{node}/rib")
            self.world.restart_rib(label)
        elif kind is FaultKind.KILL_MEMBER:
            self.world.restart_member(self._labels[node])
            self._dead.discard(node)
            self._seen = {key: counts for key, counts in self._seen.items() if key[0] != node}
            self._begin_flows(node)
        self._under_way.remove(fault)
        self._note()


def _topology(plan: Plan) -> Topology:
    """Return a plan's topology with its members as attachments, as a simulation takes it."""
    members = set(plan.members)
    links = tuple(link for link in plan.topology.links if not {link.a, link.b} & members)
    domains = tuple(
        DomainPlan(each.label, tuple(node for node in each.switches if node not in members), upper=each.upper)
        for each in plan.topology.domains
    )
    ribs = tuple(Attachment(switch, "rib", "rib") for switch in plan.ribs)
    ends = tuple(Attachment(plan.home(member), "proxy", member) for member in plan.members)
    return Topology(links, domains, (*ribs, *ends))


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
