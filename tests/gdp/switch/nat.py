"""Two switches behind NATs in virtual time: packets of a WireGuard model, and direct tunnels that decide.

The model replaces a peer at each attempt, repeats a handshake after 5 s, and sends to where a valid packet came from.
As in WireGuard, packets of the last three sessions count: two handshakes may cross.
NATs are those of RFC 4787: mappings by destination or not, and three ways to filter.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from gdp.control.endpoints import Candidate, CandidateType, Endpoint, EndpointRecord
from gdp.names import Name
from gdp.switch.direct_tunnels import Close, DirectTunnels, Silence

BORDER = Endpoint("203.0.113.1", 51_820)
MAPPING_S = 30.0
HELLO_S = 0.25
REKEY_S = 5.0  # WireGuard, section 6.1
POLL_S = 0.1


class Nat(Enum):
    """Behaviour of a NAT, the most permissive first."""

    NONE = "none"
    FULL_CONE = "full cone"
    ADDRESS = "address restricted"
    PORT = "port restricted"
    SYMMETRIC = "symmetric"
    LINUX = "Linux with an open input chain"  # conntrack keeps what comes unasked, and maps around it


def permits(one: Nat, other: Nat) -> bool:
    """Return whether a direct path is possible between two NATs."""
    return {one, other} not in ({Nat.SYMMETRIC}, {Nat.SYMMETRIC, Nat.PORT}, {Nat.SYMMETRIC, Nat.LINUX})


@dataclass(slots=True)
class Packet:
    """A packet of the model: ``init``, ``response`` or ``data`` of one session."""

    kind: str
    session: int
    hears: bool = False


@dataclass(slots=True)
class Gateway:
    """A NAT with one public address and one inner socket; mappings of its former ports lead nowhere."""

    nat: Nat
    address: str
    socket: int = 51_820
    # by the port of the socket, and by destination, or of all
    ports: dict[tuple[int, Endpoint | None], int] = field(default_factory=dict)
    sent: dict[tuple[int, Endpoint], float] = field(default_factory=dict)  # port and destination: when
    next_port: int = 40_000
    flows: dict[Endpoint, tuple[int, float]] = field(
        default_factory=dict
    )  # Linux: port and last packet, by destination
    taken: dict[tuple[Endpoint, int], float] = field(default_factory=dict)  # Linux: flows of others to the NAT itself

    def outbound(self, to: Endpoint, now_s: float) -> Endpoint:
        if self.nat is Nat.LINUX:
            port, last_s = self.flows.get(to, (self.socket, float("-inf")))
            if now_s - last_s >= MAPPING_S:
                port = self.socket
                if now_s - self.taken.get((to, port), float("-inf")) < MAPPING_S:
                    self.next_port += 1
                    port = self.next_port
            self.flows[to] = port, now_s
            return Endpoint(self.address, port)
        key = self.socket, to if self.nat is Nat.SYMMETRIC else None
        if key not in self.ports:
            self.ports[key] = self.next_port
            self.next_port += 1
        self.sent[self.ports[key], to] = now_s
        return Endpoint(self.address, self.ports[key])

    def admits(self, source: Endpoint, port: int, now_s: float) -> bool:
        if self.nat is Nat.LINUX:
            known, last_s = self.flows.get(source, (0, float("-inf")))
            if known == port and now_s - last_s < MAPPING_S:
                self.flows[source] = port, now_s
                return True
            self.taken[source, port] = now_s
            return False
        if not any(port == own and socket == self.socket for (socket, _), own in self.ports.items()):
            return False
        live = [to for (own, to), at_s in self.sent.items() if own == port and now_s - at_s < MAPPING_S]
        if self.nat in (Nat.NONE, Nat.FULL_CONE):
            return True
        if self.nat is Nat.ADDRESS:
            return any(to.address == source.address for to in live)
        return source in live


class End:
    """One switch: its NAT, its WireGuard peer, and its decision."""

    def __init__(self, world: World, name: Name, gateway: Gateway) -> None:
        self.world, self.name, self.gateway = world, name, gateway
        self.tunnels = DirectTunnels(name)
        self.records: dict[Name, EndpointRecord] = {}
        self.sequence = 0
        self.record = self.observe()
        self.is_configured = False
        self.endpoint: Endpoint | None = None
        self.offer = 0
        self.sessions: deque[int] = deque(maxlen=3)  # the newest last
        self.sent_s = self.heard_s = float("-inf")
        self.is_heard = False

    def observe(self) -> EndpointRecord:
        """Return a record with the endpoint that the border sees now."""
        self.sequence += 1
        seen = self.gateway.outbound(BORDER, self.world.now_s)
        candidates = (
            Candidate(0, CandidateType.HOST, Endpoint(f"10.{self.name[0]}.0.5", 51_820)),
            Candidate(0, CandidateType.REFLEXIVE, seen),
        )
        self.record = EndpointRecord(
            name=self.name, keys=(self.name,), candidates=candidates, sequence=self.sequence, until_unix_s=0,
            membership=b"",
        )  # fmt: skip
        return self.record

    @property
    def is_up(self) -> bool:
        return self.is_heard and self.world.now_s - self.heard_s < 4 * HELLO_S

    def poll(self) -> None:
        """Apply the actions that are due, and send what is due."""
        now_s = self.world.now_s
        self.gateway.outbound(BORDER, now_s)  # keepalives to the border
        up = {each for each in self.records if self.is_up}
        for action in self.tunnels.poll_actions(own=self.record, records=self.records, linked=(), up=up, now_s=now_s):
            if isinstance(action, Close):
                self.is_configured, self.endpoint = False, None
                self.sessions.clear()
                continue
            if isinstance(action, Silence):
                self.endpoint = None
                self.sessions.clear()
                continue
            self.is_configured = True
            if action.candidate is None:
                continue
            self.endpoint = action.candidate.endpoint
            self.sessions.clear()
            self._initiate()
        if self.endpoint is not None and now_s - max(self.sent_s, self.heard_s) >= REKEY_S:
            self._initiate()

    def hello(self) -> None:
        if self.sessions and self.endpoint is not None:
            hears = self.world.now_s - self.heard_s < 4 * HELLO_S
            self.world.send(self, self.endpoint, Packet("data", self.sessions[-1], hears))

    def _initiate(self) -> None:
        assert self.endpoint is not None
        self.sent_s = self.world.now_s
        self.offer = self.world.number()
        self.world.send(self, self.endpoint, Packet("init", self.offer))

    def receive(self, packet: Packet, source: Endpoint) -> None:
        now_s = self.world.now_s
        if not self.is_configured:
            return
        if packet.kind == "data":
            if packet.session in self.sessions:
                self.endpoint, self.heard_s, self.is_heard = source, now_s, packet.hears
            return
        if packet.kind == "response" and packet.session != self.offer:
            return
        self.sessions.append(packet.session)
        self.endpoint, self.heard_s, self.is_heard = source, now_s, False
        self.tunnels.answered(next(iter(self.records), self.name), now_s)
        if packet.kind == "init":
            self.world.send(self, source, Packet("response", packet.session))


class World:
    """Two ends and the network between them.

    Args:
        seed: of delays and losses.
        loss: chance that a packet or a copy of a record is lost.
    """

    def __init__(self, one: Nat, other: Nat, seed: int = 1, loss: float = 0.0) -> None:
        self.now_s = 0.0
        self.loss = loss
        self._random = random.Random(seed)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        gateways = Gateway(one, "192.0.2.1"), Gateway(other, "198.51.100.1")
        self.ends = [End(self, Name(bytes([at]) * 32), gateway) for at, gateway in enumerate(gateways, 1)]
        for end in self.ends:
            self._every(POLL_S, end.poll)
            self._every(HELLO_S, end.hello)
            self.publish(end)

    def number(self) -> int:
        self._count += 1
        return self._count

    def publish(self, end: End) -> None:
        """Have the record of an end reach the other one, late and perhaps after losses."""
        record = end.record
        (other,) = (each for each in self.ends if each is not end)

        def arrive() -> None:
            known = other.records.get(record.name)
            if known is None or known.sequence < record.sequence:
                other.records[record.name] = record

        late_s = self._random.uniform(0.0, 0.3)
        while self._random.random() < self.loss:
            late_s += self._random.uniform(0.3, 1.0)
        self._push(late_s, arrive)

    def send(self, end: End, to: Endpoint, packet: Packet) -> None:
        """Send a packet from an end through both NATs."""
        source = end.gateway.outbound(to, self.now_s)
        (other,) = (each for each in self.ends if each is not end)
        if self._random.random() < self.loss:
            return

        def arrive() -> None:
            is_there = other.gateway.address == to.address
            if is_there and other.gateway.admits(source, to.port, self.now_s):
                other.receive(packet, source)

        self._push(self._random.uniform(0.005, 0.06), arrive)

    def move(self, end: End, nat: Nat, address: str) -> None:
        """Move an end behind another NAT; it publishes what the border sees there."""
        end.gateway = Gateway(nat, address)
        end.observe()
        self.publish(end)

    @property
    def is_up(self) -> bool:
        return all(end.is_up for end in self.ends)

    def run(self, duration_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass; return whether ``until`` came true."""
        end_s = self.now_s + duration_s
        while self._events[0][0] <= end_s:
            self.now_s, _, action = heapq.heappop(self._events)
            action()
            if until():
                return True
        self.now_s = end_s
        return until()

    def _every(self, period_s: float, action: Callable[[], None]) -> None:
        def act() -> None:
            action()
            self._push(period_s, act)

        self._push(self._random.uniform(0.0, period_s), act)

    def _push(self, after_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now_s + after_s, self.number(), action))
