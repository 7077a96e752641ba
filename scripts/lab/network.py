"""Simulated network in memory: the protocol cores of real nodes, joined by links with delay, loss and reordering.

No I/O; its virtual clock jumps from event to event, and a seed makes it deterministic.

The frames of a switch pass the reference decision first, as on any data plane; only punted frames reach its core.
"""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import ETHER_BYTES, ethernet
from gdp.sansio import BROADCAST, OutgoingFrames, ProtocolCore, ReceivedFrame, Timestamps, new_tuple
from gdp.switch.forwarder import Drop, Forward, decide, rewrite
from gdp.switch.table import Table

_STALLED_MAX: Final = 8_192  # frames that wait for a frozen node, about the capacity of a socket
_SAME_INSTANT_MAX: Final = 100  # timers of one node in one instant; more is an endless loop
EPOCH_UNIX_S: Final = 1_800_000_000.0
_UNLIMITED: Final = float("inf")
_QUIET: Final = object()  # result of an event in which no core was called

Tap = Callable[[float, str, str, bytes], None]


@dataclass(slots=True)
class SimLink:
    """A simulated link between two ports.

    Args:
        delay_s: one way.
        jitter_s: largest random addition to the delay; frames may then overtake each other.
        loss: share of frames that are lost, 0 to 1.
        burst_frames: mean length of a run of lost frames in one direction (Gilbert's model); 1: they are independent.
        bytes_s: rate of each direction; frames beyond it wait in a FIFO.
        fifo_s: longest wait in that FIFO; a frame that would wait longer is lost.
        spared: node towards which no frame is lost at random.
    """

    delay_s: float = 0.0005
    jitter_s: float = 0.0
    loss: float = 0.0
    mtu: int = 1_500
    is_up: bool = True
    bytes_s: float = _UNLIMITED
    burst_frames: float = 1.0
    fifo_s: float = _UNLIMITED
    free_s: dict[bytes, float] = field(default_factory=dict)  # by receiver: when the last frame has left
    spared: str = ""
    in_burst: set[bytes] = field(default_factory=set)  # receivers whose last frame was lost

    def loses(self, to: bytes, chance: float) -> bool:
        """Return whether a frame towards a receiver is lost; ``chance``: random, 0 to 1."""
        into = self.loss
        if self.burst_frames > 1:
            leaves = 1 / self.burst_frames
            into = 1 - leaves if to in self.in_burst else leaves * self.loss / max(1 - self.loss, leaves * self.loss)
        is_lost = chance < into
        (self.in_burst.add if is_lost else self.in_burst.discard)(to)
        return is_lost

    def is_full(self, to: bytes, now_s: float) -> bool:
        """Return whether the FIFO towards a receiver takes no further frame."""
        return self.free_s.get(to, now_s) - now_s > self.fifo_s

    def leaves_s(self, to: bytes, size: int, now_s: float) -> float:
        """Queue a frame of ``size`` bytes towards a receiver; return when its last byte has left."""
        if self.bytes_s == _UNLIMITED and to not in self.free_s:
            return now_s
        self.free_s[to] = max(self.free_s.get(to, now_s), now_s) + size / self.bytes_s
        return self.free_s[to]


@dataclass(slots=True)
class _End:
    node: str
    port: int
    mac: bytes


@dataclass(slots=True, kw_only=True)
class _Node:
    machine: ProtocolCore
    table: Table | None
    ports: dict[int, tuple[SimLink, _End, _End]] = field(default_factory=dict)  # link, own end, far end
    costs: dict[int, int] = field(default_factory=dict)  # by port
    timer_s: float | None = None
    due_s: float | None = None  # of its own timer; one that moved later keeps the event at ``timer_s``
    fired_s: float = float("-inf")
    fired: int = 0  # number of timers in the instant ``fired_s``
    is_alive: bool = True
    came: Counter[int] = field(default_factory=Counter)  # frames, by port
    stalled: list[tuple[_End, bytes]] | None = None  # frames that arrived while it was frozen


class SimNetwork:
    """Nodes, links, and the events between them.

    ``seed``: of all random choices. ``taps``: called for each frame that enters a link, with (second, from node, to
    node, frame with Ethernet header). ``drops``: frames that the simulated data planes dropped, by reason.
    """

    def __init__(self, seed: int = 1) -> None:
        self._random = random.Random(seed)
        self._nodes: dict[str, _Node] = {}
        self._events: list[tuple[float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._count = 0
        self._now_s = 1_000.0
        self.taps: list[Tap] = []
        self.drops: Counter[DropReason] = Counter()
        self.lost = 0

    @property
    def now(self) -> Timestamps:
        """Return the present simulated time."""
        return new_tuple(Timestamps, (self._now_s, EPOCH_UNIX_S + self._now_s))

    def random_bytes(self, size: int) -> bytes:
        """Return reproducible bytes; never for secrets."""
        return self._random.randbytes(size)

    def add(self, name: str, machine: ProtocolCore, table: Table | None = None) -> None:
        """Add a node; with a table it forwards what the table decides."""
        node = self._nodes[name] = _Node(machine=machine, table=table)
        machine.count_arrivals(node.came.__getitem__)

    def connect(self, a: str, b: str, sim_link: SimLink | None = None, cost: int = 10) -> SimLink:
        """Join two nodes by a link; return the link, which may be changed while time runs."""
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
        """Cut or restore a link; both ends detect it at once, as on a real port."""
        sim_link.is_up = up
        self._tell(sim_link)

    def set_mtu(self, sim_link: SimLink, mtu: int) -> None:
        """Change the MTU of a link, in bytes after the Ethernet header; both ends detect it at once.

        Frames already on the link still arrive.
        """
        sim_link.mtu = mtu
        self._tell(sim_link)

    def set_cost(self, sim_link: SimLink, cost: int) -> None:
        """Change the cost of a link at both ends."""
        for node in self._nodes.values():
            node.costs |= {port: cost for port, (its, _, _) in node.ports.items() if its is sim_link}
        self._tell(sim_link)

    def stop(self, name: str) -> None:
        """Kill a node without a goodbye."""
        self._nodes[name].is_alive = False

    def freeze(self, name: str) -> None:
        """Stop a node's time; arriving frames wait, up to a limit."""
        self._nodes[name].stalled = []

    def thaw(self, name: str) -> None:
        """Resume a frozen node."""
        node = self._nodes[name]
        stalled, node.stalled = node.stalled or [], None
        for end, frame in stalled:
            self._deliver(end, frame)
        self._arm(name)

    def replace(self, name: str, machine: ProtocolCore, table: Table | None = None) -> None:
        """Restart a node without any state, on the same links."""
        before = self._nodes[name]
        node = self._nodes[name] = _Node(machine=machine, table=table, ports=before.ports, costs=before.costs)
        machine.count_arrivals(node.came.__getitem__)
        for port, (sim_link, own, _) in node.ports.items():
            machine.add_port(port, own.mac, sim_link.mtu, node.costs[port], self.now)
            if not sim_link.is_up:
                machine.port_changed(port, False, self.now)
        self._arm(name)

    def call(self, delay_s: float, action: Callable[[], None]) -> None:
        """Run an action after a delay."""
        self._push(self._now_s + delay_s, action)

    def send_pending(self, name: str) -> None:
        """Send the frames of a core after a call from outside."""
        self._settle(name)

    def run(self, duration_s: float, until: Callable[[], bool] | None = None) -> bool:
        """Let time pass; return whether ``until`` came true (True without one), after an event that called a core.

        Raises:
            LocalError: a core's timer is due repeatedly in one instant, which would be an endless loop on a real clock.
        """
        end_s = self._now_s + duration_s
        if until is not None and until():
            return True
        while self._events and self._events[0][0] <= end_s:
            at_s, _, action, arguments = heapq.heappop(self._events)
            self._now_s = at_s if at_s > self._now_s else self._now_s
            if action(*arguments) is not _QUIET and until is not None and until():
                return True
        self._now_s = end_s
        return until is None

    def inject(self, name: str, port: int, frame: bytes, mac: bytes = b"\x02evil\x00") -> None:
        """Deliver a frame (from its header on) to a node's port, as if a stranger on the link had sent it."""
        _, own, _ = self._nodes[name].ports[port]
        self._deliver(own, ethernet(BROADCAST, mac) + frame)

    def _tell(self, sim_link: SimLink) -> None:
        """Report the state of a link to both ends, as a node's runtime does."""
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

    def _push(self, at_s: float, action: Callable[..., object], *arguments: object) -> None:
        self._count += 1
        heapq.heappush(self._events, (at_s, self._count, action, arguments))

    def _arm(self, name: str) -> None:
        """Schedule the call of a core for when its next timer is due."""
        node = self._nodes[name]
        due_s = node.due_s = node.machine.get_timer()
        if due_s is None or node.stalled is not None or (node.timer_s is not None and node.timer_s <= due_s):
            return
        node.timer_s = max(due_s, self._now_s)
        self._push(node.timer_s, self._timer, name, node)

    def _timer(self, name: str, node: _Node) -> object:
        is_present = self._nodes[name] is node and node.is_alive
        if not is_present or node.timer_s is None or node.timer_s > self._now_s:
            return _QUIET
        node.timer_s = None
        if node.stalled is not None:
            return _QUIET
        node.fired = node.fired + 1 if node.fired_s == self._now_s else 1
        node.fired_s = self._now_s
        if node.fired > _SAME_INSTANT_MAX:
            raise LocalError(f"{name} wants to be called again and again at {self._now_s}")
        if node.due_s is not None and node.due_s <= self._now_s + 1e-9:
            node.machine.handle_timer(Timestamps(self._now_s + 1e-6, EPOCH_UNIX_S + self._now_s))
        self._settle(name)
        return None

    def _settle(self, name: str) -> None:
        node = self._nodes[name]
        while transmits := node.machine.frames_to_send(self._now_s):
            node.machine.frames_sent(self._now_s)
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
        elif (sim_link.free_s and sim_link.is_full(far.mac, self._now_s)) or (
            sim_link.loss and far.node != sim_link.spared and sim_link.loses(far.mac, self._random.random())
        ):
            self.lost += 1
        else:
            delay_s = sim_link.delay_s + (self._random.random() * sim_link.jitter_s if sim_link.jitter_s else 0.0)
            left_s = sim_link.leaves_s(far.mac, len(frame), self._now_s)
            self._push(left_s + delay_s, self._arrive, sim_link, far, frame)

    def _arrive(self, sim_link: SimLink, end: _End, frame: bytes) -> object:
        return self._deliver(end, frame) if sim_link.is_up else _QUIET

    def _deliver(self, end: _End, frame: bytes) -> object:
        node = self._nodes[end.node]
        if not node.is_alive or frame[:6] not in (end.mac, BROADCAST):
            return _QUIET
        if node.stalled is not None:
            if len(node.stalled) < _STALLED_MAX:
                node.stalled.append((end, frame))
            return _QUIET
        node.came[end.port] += 1
        if node.table is not None:
            mtus = {port: sim_link.mtu for port, (sim_link, _, _) in node.ports.items() if sim_link.is_up}
            decision = decide(frame, node.table.entries, mtus, node.table.sides, end.port, node.table.paces)
            if isinstance(decision, Forward):
                if decision.lost:
                    self.drops.update(decision.lost)
                for port, macs in decision.hops:
                    self._send(node.ports[port], rewrite(frame, macs))
                return _QUIET
            if isinstance(decision, Drop):
                self.drops[decision.reason] += 1
                return _QUIET
        node.machine.receive([new_tuple(ReceivedFrame, (end.port, frame[6:12], frame[ETHER_BYTES:], 0.0))], self.now)
        self._settle(end.node)
        return None
