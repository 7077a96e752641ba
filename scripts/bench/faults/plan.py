"""Plan of a network under test, as data: switches, RIBs, members, and their flows and services.

Sans-I/O. A member is a node of the topology without a switch of its own, joined to its home switch by one link. That
link may be moved to the other switches it lists.

A random network, the same for the same seed, has four domains in three tiers (``top`` over ``middle``, that over
``left`` and ``right``), each a ring of switches with some chords. Two pairs of borders join domains of neighbouring
tiers, so any single switch or link may fail. RIBs: two in ``top`` and in ``right``, one in the others.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from lab.faults import Broken
from lab.topology import Link, Topology, make_topology


@dataclass(frozen=True, slots=True)
class Flow:
    """Topic with one publisher.

    ``size``: bytes of each message. ``waits``: it begins when publisher and readers get a signal, which starts the
    first flow that still waits.
    """

    topic: str
    publisher: str
    readers: tuple[str, ...]
    reliable: bool = True
    hz: float = 20.0
    size: int = 100
    waits: bool = False

    def has(self, member: str) -> bool:
        """Return whether a member takes part."""
        return member == self.publisher or member in self.readers


@dataclass(frozen=True, slots=True)
class Service:
    """Service with its replicas and its clients."""

    name: str
    servers: tuple[str, ...]
    clients: tuple[str, ...]
    hz: float = 5.0
    timeout_s: float = 5.0

    def has(self, member: str) -> bool:
        """Return whether a member takes part."""
        return member in self.servers or member in self.clients


@dataclass(frozen=True, slots=True)
class Plan:
    """One run without its faults.

    Args:
        topology: members are nodes of it, too.
        members: those nodes that run no switch.
        homes: of members (and switches) whose link moves: the possible switches, the first at the start.
        flows, services: traffic between members; the index in both together is the channel.
    """

    topology: Topology
    members: tuple[str, ...]
    homes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    flows: tuple[Flow, ...] = ()
    services: tuple[Service, ...] = ()

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
        return homes[0] if homes else self.topology.neighbours(mover)[0]

    def channels(self, member: str) -> Iterable[tuple[int, Flow | Service]]:
        """Return what a member takes part in, with its channel."""
        parts: tuple[Flow | Service, ...] = (*self.flows, *self.services)
        return [(channel, part) for channel, part in enumerate(parts) if part.has(member)]


VICTIM: Final = "victim"  # the member whose membership is revoked
REVOKED_TOPIC: Final = "/of-the-victim"
_UPPERS: Final = {"middle": "top", "left": "middle", "right": "middle"}
_RIBS: Final = {"top": 2, "middle": 1, "left": 1, "right": 2}
_COSTS: Final = (10, 10, 10, 12, 15, 20)
_HOMES: Final = 3
_IMAGE_BYTES: Final = 30_000
_READERS: Final = ("read1", "read2", "read3")


def random_network(
    seed: int, switches: int = 14, *, rate: float = 1.0, one_rib: bool = False, image_bits_s: float = 0.0
) -> Plan:
    """Return a network with so many switches, and its members, flows and services.

    ``switches``: at least 12. ``rate``: factor on every rate of messages and calls. ``one_rib``: one in each domain.
    ``image_bits_s``: what a best-effort flow of images offers in addition; 0: there is none.
    """
    chance = random.Random(f"network {seed}")
    sizes = _sizes(switches, chance)
    domains = {label: tuple(f"{label[0]}{n}" for n in range(1, size + 1)) for label, size in sizes.items()}
    links = [link for members in domains.values() for link in _ring(members, chance)]
    for lower, upper in _UPPERS.items():
        ends = zip(chance.sample(domains[lower], 2), chance.sample(domains[upper], 2), strict=True)
        links += [Link(a, b, cost=chance.choice(_COSTS)) for a, b in ends]
    ribs = [switch for label, count in _RIBS.items() for switch in chance.sample(domains[label], count)]
    if one_rib:
        ribs = list({switch[0]: switch for switch in ribs}.values())
    members = _members(domains, chance)
    topology, names = make_topology(domains, _UPPERS, links, ribs, members)
    everywhere = [switch for each in domains.values() for switch in each]
    homes = {mover: _homes(members[mover], everywhere, chance) for mover in ("talk1", "read1")}
    flows: tuple[Flow, ...] = (
        Flow("/reliable/1", "talk1", ("read1", "read2"), hz=40 * rate),
        Flow("/reliable/2", "talk2", ("read2", "read3"), hz=25 * rate, size=1_000),
        Flow("/reliable/3", "talk3", ("read1", "read3", "talk1"), hz=10 * rate, size=8_000),
        Flow("/best-effort/1", "talk1", ("read2", "read3"), reliable=False, hz=40 * rate),
        Flow("/best-effort/2", "talk3", _READERS, reliable=False, hz=20 * rate, size=3_000),
        Flow(REVOKED_TOPIC, VICTIM, ("read1", "read3"), hz=20 * rate),
    )
    if image_bits_s:
        hz = image_bits_s / 8 / _IMAGE_BYTES
        flows += (Flow("/images", "talk1", _READERS, reliable=False, hz=hz, size=_IMAGE_BYTES),)
    services = (
        Service("/add", ("serve1", "serve2"), ("talk1", "read3"), hz=4 * rate),
        Service("/plan", ("serve2", "serve3", "serve1"), ("talk2",), hz=4 * rate),
    )
    return Plan(topology, names, homes, flows, services)


def _sizes(switches: int, chance: random.Random) -> dict[str, int]:
    sizes = dict.fromkeys(("top", *_UPPERS), 3)
    for _ in range(switches - sum(sizes.values())):
        sizes[chance.choice(list(sizes))] += 1
    return sizes


def _ring(members: tuple[str, ...], chance: random.Random) -> list[Link]:
    order = chance.sample(members, len(members))
    pairs = list(zip(order, [*order[1:], order[0]], strict=True))
    if len(order) > 3 and chance.random() < 0.7:
        at = chance.randrange(len(order))
        pairs.append((order[at], order[(at + 2) % len(order)]) if len(order) > 4 else (order[0], order[2]))
    return [Link(a, b, cost=chance.choice(_COSTS)) for a, b in pairs]


def _members(domains: dict[str, tuple[str, ...]], chance: random.Random) -> dict[str, str]:
    """Return members with their homes, spread over the domains."""
    names = ("talk1", "talk2", "talk3", *_READERS, "serve1", "serve2", "serve3", VICTIM)
    labels = chance.sample(list(domains), len(domains)) * 3
    return {name: chance.choice(domains[label]) for name, label in zip(names, labels, strict=False)}


def _homes(home: str, everywhere: list[str], chance: random.Random) -> tuple[str, ...]:
    others = [switch for switch in everywhere if switch != home]
    return (home, *chance.sample(others, _HOMES - 1))


class Oracle:
    """Oracle of the pairs that must be connected. ``plan``: the network without faults."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._switches = frozenset(plan.switches)
        self._links = [link.ends() for link in plan.topology.links if link.ends() <= self._switches]

    @property
    def links(self) -> list[frozenset[str]]:
        """Return the links between switches."""
        return list(self._links)

    def part_of(self, switch: str, broken: Broken) -> frozenset[str]:
        """Return the live switches that a live switch reaches, itself included."""
        topology, dead = self._plan.topology, {*broken.switches, *self._plan.members}
        return topology.reached(switch, down=broken.links, dead=dead)

    def is_whole(self, broken: Broken) -> bool:
        """Return whether all live switches reach each other."""
        live = self._switches - broken.switches
        return bool(live) and self.part_of(min(live), broken) == live

    def must_talk(self, a: str, b: str, broken: Broken) -> bool:
        """Return whether two members must be able to communicate."""
        homes = [broken.at.get(member, self._plan.home(member)) for member in (a, b)]
        if {a, b} & broken.members or set(homes) & broken.switches:
            return False
        return homes[1] in self.part_of(homes[0], broken)

    def pairs(self) -> Iterator[tuple[int, str, str]]:
        """Yield channel, publisher and reader of each flow that does not wait."""
        for channel, flow in enumerate(self._plan.flows):
            if not flow.waits:
                yield from ((channel, flow.publisher, reader) for reader in flow.readers)
