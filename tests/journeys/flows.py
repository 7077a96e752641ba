"""Topic from one member of a simulation to others, and its received messages."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import ceil
from typing import Final

from gdp.client.delivery import Delivered
from gdp.client.participant import Participant, Topic
from gdp.client.publisher import Publisher
from gdp.client.send_options import DEFAULT_OPTIONS, SendOptions
from gdp.frame.codec import ETHER_BYTES, Header, decode
from gdp.intervals import SCAPY_KEEPALIVE_MS
from gdp.names import Name
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology, ring5

ROBOT, SERVER = "nuc1/robot", "nuc5/server"
ROW: Final = Topology(  # three of the ring's switches in two domains: a third of its frames
    (Link("nuc1", "nuc2"), Link("nuc2", "nuc5")),
    (DomainPlan("school", ("nuc1", "nuc2"), upper="cloud"), DomainPlan("cloud", ("nuc5",))),
    (
        *(Attachment("nuc2", "rib", "rib"), Attachment("nuc5", "rib", "rib")),
        *(Attachment("nuc1", "proxy", "robot"), Attachment("nuc5", "proxy", "server")),
    ),
)
LEASE_S = 2.5  # of names; with it three leases outlast those of readers and of branches, too
LEASES = 3.05  # after which a flow has outlived three, whatever the rounding
STEP_S = 0.25  # between messages of a flow that is to outlive leases


@dataclass(slots=True)
class Flow:
    """Publisher of a topic and its readers, by label."""

    world: Simulation
    name: str
    source: str
    topic: Topic
    publisher: Publisher
    got: dict[str, list[Delivered]] = field(default_factory=dict)

    @property
    def member(self) -> Participant:
        """Return the member that publishes."""
        return self.world.members[self.source]

    def read_by(self, label: str) -> None:
        """Let a member read the topic from now on."""
        reader = self.world.members[label]
        reader.subscribe(self.world.topic(self.name, reader, [Right.READ]))
        self.got[label] = []
        self.world.network.send_pending(label)

    def publish(self, message: bytes) -> None:
        """Publish now."""
        self.publisher.publish(message)
        self.member.flush(self.world.network.now.mono_s)
        self.world.network.send_pending(self.source)

    def stream(self, count: int, every_s: float, size: int = 3_000) -> None:
        """Publish numbered messages from now on, at a steady rate."""
        for number in range(count):
            message = number.to_bytes(4, "big") + bytes(size)
            self.world.network.call(number * every_s, partial(self.publish, message))

    def collect(self) -> None:
        """Poll the received messages of each reader."""
        for label, got in self.got.items():
            if messages := self.world.members[label].poll_messages():
                got += [each.delivered for each in messages if each.topic == self.topic.name]

    def numbers(self, label: str) -> list[int]:
        """Return the numbers that ``stream`` gave to the messages that a reader has."""
        self.collect()
        return [int.from_bytes(each.message[:4], "big") for each in self.got[label]]

    def has(self, label: str, count: int) -> bool:
        """Return whether this many messages came to a reader."""
        self.collect()
        return len(self.got[label]) >= count

    def hops(self, label: str) -> list[int]:
        """Return how many switches each message passed on its path to a reader."""
        self.collect()
        return [each.hops for each in self.got[label]]

    def outlive(self, *labels: str, negative: bool = False, leases: float = LEASES) -> None:
        """Publish at a steady rate until three leases are over; each of these readers, or all, gets all of it in order.

        Other readers that were there get none of it; ``negative``: no reader does.
        """
        _outlive([self], () if negative else labels or tuple(self.got), leases)

    def is_read_by(self, count: int) -> bool:
        """Return whether this many readers have introduced themselves."""
        return self.publisher.readers >= count


def outlive_together(*flows: Flow) -> None:
    """Do as ``Flow.outlive`` with all of these flows at the same time; each of their readers gets all of its flow."""
    _outlive(flows, tuple(label for flow in flows for label in flow.got), leases=LEASES)


def _outlive(flows: Sequence[Flow], expected: Collection[str], leases: float) -> None:
    world = flows[0].world
    got = {(flow.name, label): its for flow in flows for label, its in flow.got.items()}
    of = {flow.topic.name: flow for flow in flows}

    def collect() -> None:
        for label in dict.fromkeys(label for _, label in got):
            for each in world.members[label].poll_messages():
                if (flow := of.get(each.topic)) is not None and label in flow.got:
                    flow.got[label].append(each.delivered)

    collect()
    before = {key: len(its) for key, its in got.items()}
    count = ceil(leases * world.lease_s / STEP_S)
    sent = [b"outlives %d" % number for number in range(count)]
    for number, message in enumerate(sent):
        for flow in flows:
            world.network.call(number * STEP_S, partial(flow.publish, message))
    world.network.run(count * STEP_S)

    def missing() -> dict[str, str]:
        collect()
        return {
            f"{name} at {label}": f"{len(its) - before[name, label]} of {count}"
            for (name, label), its in got.items()
            if label in expected and len(its) < before[name, label] + count
        }

    assert world.network.run(5, lambda: not missing()), missing()
    for (name, label), its in got.items():
        later = [each.message for each in its[before[name, label] :]]
        assert later == (sent if label in expected else []), f"what {label} got of {name}"


@dataclass(slots=True)
class Tap:
    """Observer of frames of some kinds that enter one link in one direction."""

    a: str
    b: str
    headers: list[Header] = field(default_factory=list)
    frames: list[bytes] = field(default_factory=list)  # from the header on

    def __call__(self, _at_s: float, a: str, b: str, frame: bytes) -> None:
        if (a, b) == (self.a, self.b):
            self.headers.append(decode(frame, ETHER_BYTES))
            self.frames.append(frame[ETHER_BYTES:])

    def count(self, kind: int, destination: Name | None = None) -> int:
        """Return how many frames of a kind were seen, to one destination if given."""
        return sum(1 for each in self.headers if each.kind == kind and destination in (None, each.destination))


def ring(
    seed: int = 1,
    transits: Mapping[str, tuple[str, ...]] | None = None,
    *,
    lease_s: float = LEASE_S,
    keepalive_ms: int | None = SCAPY_KEEPALIVE_MS,
) -> Simulation:
    """Return the ring of five, with every member attached."""
    world = Simulation(topology=ring5(), seed=seed, transits=transits, lease_s=lease_s, keepalive_ms=keepalive_ms)
    assert world.run_until_attached()
    return world


def row(seed: int = 1, *, lease_s: float = LEASE_S, keepalive_ms: int | None = SCAPY_KEEPALIVE_MS) -> Simulation:
    """Return ``ROW``, with every member attached, for tests whose subject is not the path."""
    world = Simulation(topology=ROW, seed=seed, lease_s=lease_s, keepalive_ms=keepalive_ms)
    assert world.run_until_attached()
    return world


def advertise(
    world: Simulation,
    name: str = "/chatter",
    source: str = ROBOT,
    *,
    reliable: bool = True,
    depth: int = 0,
    is_global: bool = True,
    urgent: bool = False,
    options: SendOptions = DEFAULT_OPTIONS,
) -> Flow:
    """Return a topic that a member publishes from now on."""
    member = world.members[source]
    topic = world.topic(name, member, [Right.PUBLISH])
    publisher = member.advertise(
        topic, b"described", reliable=reliable, depth=depth, is_global=is_global, urgent=urgent, options=options
    )
    world.network.send_pending(source)
    return Flow(world, name, source, topic, publisher)


def flowing(
    world: Simulation,
    name: str = "/chatter",
    source: str = ROBOT,
    readers: tuple[str, ...] = (SERVER,),
    *,
    reliable: bool = True,
) -> Flow:
    """Return a topic with readers that have introduced themselves."""
    flow = advertise(world, name, source, reliable=reliable)
    for label in readers:
        flow.read_by(label)
    assert world.network.run(5, lambda: flow.is_read_by(len(readers)))
    return flow
