"""A network in memory: the same machines that run on real sockets, joined by links with delay, loss and reordering.

Its clock jumps from event to event.

Place: shell, though without any I/O; deterministic for a seed.

A switch's frames go through the reference decision first, like on any data plane; only what that hands up reaches its
machine.
"""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import ETHER_BYTES, ethernet
from gdp.sansio import BROADCAST, OutgoingFrames, ProtocolCore, ReceivedFrame, Timestamps
from gdp.switch.forwarder import Drop, Forward, decide, rewrite
from gdp.switch.table import Table

__all__ = ["SimLink", "SimNetwork", "Tap"]

_STALLED_MAX: Final = 8_192  # frames that wait for a frozen node, about what a socket holds
_SAME_INSTANT_MAX: Final = 100  # timers of one node, before it counts as one that never moves on
EPOCH_UNIX_S: Final = 1_800_000_000.0

Tap = Callable[[float, str, str, bytes], None]


@dataclass(slots=True)
class SimLink:
    """What lies between two ports.

    Args:
        delay_s: one way.
        jitter_s: up to so much more, at random; frames may then overtake each other.
        loss: chance that a frame is lost, 0 to 1.
    """

    delay_s: float = 0.0005
    jitter_s: float = 0.0
    loss: float = 0.0
    mtu: int = 1_500
    is_up: bool = True


@dataclass(slots=True)
class _End:
    node: str
    port: int
    mac: bytes


@dataclass(slots=True)
class _Node:
    machine: ProtocolCore
    table: Table | None
    ports: dict[int, tuple[SimLink, _End, _End]] = field(default_factory=dict)  # cable, own end, far end
    costs: dict[int, int] = field(default_factory=dict)  # by port
    timer_s: float | None = None
    fired_s: float = float("-inf")
    fired: int = 0  # times in the instant ``fired_s``
    is_alive: bool = True
    stalled: list[tuple[_End, bytes]] | None = None  # what came while it was frozen


class SimNetwork:
    """Nodes, cables, and the events between them.

    Args:
        seed: of all chance.

    Attributes:
        taps: called for each frame that enters a cable, with (second, from node, to node, frame with Ethernet header).
        drops: what the simulated data planes dropped.
    """

    def __init__(self, seed: int = 1) -> None:
        self._random = random.Random(seed)
        self._nodes: dict[str, _Node] = {}
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._now_s = 1_000.0
        self.taps: list[Tap] = []
        self.drops: Counter[DropReason] = Counter()
        self.lost = 0

    @property
    def now(self) -> Timestamps:
        """Return the present moment."""
        return Timestamps(self._now_s, EPOCH_UNIX_S + self._now_s)

    def random_bytes(self, size: int) -> bytes:
        """Return reproducible bytes; only for what needs no secrecy."""
        return self._random.randbytes(size)

    def add(self, name: str, machine: ProtocolCore, table: Table | None = None) -> None:
        """Add a node; with a table it forwards what the table decides."""
        self._nodes[name] = _Node(machine, table)

    def connect(self, a: str, b: str, sim_link: SimLink | None = None, cost: int = 10) -> SimLink:
        """Join two nodes by a cable; return it, to be changed while time goes on."""
        sim_link = sim_link or SimLink()
        ends = [_End(name, len(self._nodes[name].ports), self._mac()) for name in (a, b)]
        for own, far in (ends, ends[::-1]):
            node = self._nodes[own.node]
            node.ports[own.port] = (sim_link, own, far)
            node.costs[own.port] = cost
            node.machine.add_port(own.port, own.mac, sim_link.mtu, cost, self.now)
            self._arm(own.node)
        return sim_link

    def set_link(self, sim_link: SimLink, up: bool) -> None:
        """Pull a cable or put it back; both ends notice at once, as they do on a real port."""
        sim_link.is_up = up
        self._tell(sim_link)

    def set_mtu(self, sim_link: SimLink, mtu: int) -> None:
        """Let a cable take other sizes, in bytes after the Ethernet header; both ends notice at once.

        What is under way on it still arrives.
        """
        sim_link.mtu = mtu
        self._tell(sim_link)

    def set_cost(self, sim_link: SimLink, cost: int) -> None:
        """Make a cable dearer or cheaper at both ends."""
        for node in self._nodes.values():
            node.costs |= {port: cost for port, (its, _, _) in node.ports.items() if its is sim_link}
        self._tell(sim_link)

    def stop(self, name: str) -> None:
        """Kill a node: it says no goodbye."""
        self._nodes[name].is_alive = False

    def freeze(self, name: str) -> None:
        """Give a node no more time; what comes waits, as far as there is room."""
        self._nodes[name].stalled = []

    def thaw(self, name: str) -> None:
        """Let a frozen node go on."""
        node = self._nodes[name]
        stalled, node.stalled = node.stalled or [], None
        for end, frame in stalled:
            self._deliver(end, frame)
        self._arm(name)

    def replace(self, name: str, machine: ProtocolCore, table: Table | None = None) -> None:
        """Start a node anew, with nothing remembered, on the same cables."""
        before = self._nodes[name]
        node = self._nodes[name] = _Node(machine, table, before.ports, before.costs)
        for port, (sim_link, own, _) in node.ports.items():
            machine.add_port(port, own.mac, sim_link.mtu, node.costs[port], self.now)
            if not sim_link.is_up:
                machine.port_changed(port, False, self.now)
        self._arm(name)

    def call(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something later."""
        self._push(self._now_s + delay_s, action)

    def touch(self, name: str) -> None:
        """Carry away what a machine has to send after it was called from outside."""
        self._settle(name)

    def run(self, duration_s: float, until: Callable[[], bool] | None = None) -> bool:
        """Let time go on; return whether ``until`` came true (True without one).

        Raises:
            LocalError: a machine's timer is due again and again in one instant: on a real clock it would spin.
        """
        end_s = self._now_s + duration_s
        if until is not None and until():
            return True
        while self._events and self._events[0][0] <= end_s:
            at_s, _, action = heapq.heappop(self._events)
            self._now_s = max(self._now_s, at_s)
            action()
            if until is not None and until():
                return True
        self._now_s = end_s
        return until is None

    def inject(self, name: str, port: int, frame: bytes, mac: bytes = b"\x02evil\x00") -> None:
        """Let a frame (from its header on) come in at a node's port, as if a stranger on the link had sent it."""
        _, own, _ = self._nodes[name].ports[port]
        self._deliver(own, ethernet(BROADCAST, mac) + frame)

    def _tell(self, sim_link: SimLink) -> None:
        """Tell both ends of a cable how it now is, as a node's shell does."""
        for name, node in self._nodes.items():
            for port, (its, own, _) in node.ports.items():
                if its is not sim_link or not node.is_alive:
                    continue
                if sim_link.is_up:
                    node.machine.add_port(port, own.mac, sim_link.mtu, node.costs[port], self.now)
                else:
                    node.machine.port_changed(port, False, self.now)
                self._settle(name)

    def _mac(self) -> bytes:
        self._count += 1
        return b"\x02" + self._count.to_bytes(5, "big")

    def _push(self, at_s: float, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._events, (at_s, self._count, action))

    def _arm(self, name: str) -> None:
        """See that the machine is called when its next timer is due."""
        node = self._nodes[name]
        due_s = node.machine.get_timer()
        if due_s is None or (node.timer_s is not None and node.timer_s <= due_s):
            return
        node.timer_s = max(due_s, self._now_s)
        self._push(node.timer_s, lambda: self._timer(name, node))

    def _timer(self, name: str, node: _Node) -> None:
        if self._nodes[name] is not node or not node.is_alive:
            return
        if node.timer_s is None or node.timer_s > self._now_s:
            return
        node.timer_s = None
        if node.stalled is not None:
            return
        node.fired = node.fired + 1 if node.fired_s == self._now_s else 1
        node.fired_s = self._now_s
        if node.fired > _SAME_INSTANT_MAX:
            raise LocalError(f"{name} wants to be called again and again at {self._now_s}")
        due_s = node.machine.get_timer()
        if due_s is not None and due_s <= self._now_s + 1e-9:
            node.machine.handle_timer(Timestamps(self._now_s + 1e-6, EPOCH_UNIX_S + self._now_s))
        self._settle(name)

    def _settle(self, name: str) -> None:
        node = self._nodes[name]
        while transmits := node.machine.frames_to_send():
            for transmit in transmits:
                self._transmit(node, transmit)
        self._arm(name)

    def _transmit(self, node: _Node, transmit: OutgoingFrames) -> None:
        wired = node.ports.get(transmit.port)
        if wired is None:
            raise LocalError(f"no port {transmit.port}")
        for frame in transmit.frames:
            self._send(wired, ethernet(transmit.mac, wired[1].mac) + frame)

    def _send(self, wired: tuple[SimLink, _End, _End], frame: bytes) -> None:
        sim_link, own, far = wired
        for tap in self.taps:
            tap(self._now_s, own.node, far.node, frame)
        if not sim_link.is_up or len(frame) - ETHER_BYTES > sim_link.mtu:
            self.drops[DropReason.PORT_DOWN if not sim_link.is_up else DropReason.TOO_BIG] += 1
        elif sim_link.loss and self._random.random() < sim_link.loss:
            self.lost += 1
        else:
            delay_s = sim_link.delay_s + (self._random.random() * sim_link.jitter_s if sim_link.jitter_s else 0.0)
            self._push(self._now_s + delay_s, lambda: self._arrive(sim_link, far, frame))

    def _arrive(self, sim_link: SimLink, end: _End, frame: bytes) -> None:
        if sim_link.is_up:
            self._deliver(end, frame)

    def _deliver(self, end: _End, frame: bytes) -> None:
        node = self._nodes[end.node]
        if not node.is_alive or frame[:6] not in (end.mac, BROADCAST):
            return
        if node.stalled is not None:
            if len(node.stalled) < _STALLED_MAX:
                node.stalled.append((end, frame))
            return
        if node.table is not None:
            mtus = {port: sim_link.mtu for port, (sim_link, _, _) in node.ports.items() if sim_link.is_up}
            ack = decide(frame, node.table.entries, mtus, node.table.sides, end.port)
            if isinstance(ack, Drop):
                self.drops[ack.reason] += 1
                return
            if isinstance(ack, Forward):
                self.drops.update(ack.lost)
                for port, macs in ack.hops:
                    self._send(node.ports[port], rewrite(frame, macs))
                return
        node.machine.receive([ReceivedFrame(end.port, frame[6:12], frame[ETHER_BYTES:])], self.now)
        self._settle(end.node)
