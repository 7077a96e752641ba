"""Random network for a chaos run, the same for the same seed.

Sans-I/O. Four domains in three tiers (``top`` over ``middle``, that over ``left`` and ``right``), each a ring of
switches with some chords. Two pairs of borders join domains of neighbouring tiers, so any single switch or link may
fail. RIBs: two in ``top`` and in ``right``, one in the others.
"""

from __future__ import annotations

import random
from typing import Final

from topologies import make_topology

from faults.plan import Flow, Plan, Service
from lab.topology import Link

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

    Args:
        switches: at least 12.
        rate: factor on every rate of messages and calls.
        one_rib: one in each domain.
        image_bits_s: what a best-effort flow of images offers in addition; 0: there is none.
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
