"""Many switches in eight domains: they discover each other, and a message reaches its reader."""

from __future__ import annotations

import random

import pytest

from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import flowing
from tests.lanes import nightly

DOMAINS = 8


def wide(switches: int, seed: int = 1) -> Topology:
    """Return domains that are each a random tree with some more links, joined to the first and to some others.

    Args:
        switches: of each domain.

    The first is the tier above all the others; each has its RIB at its first switch, and a proxy at its last.
    """
    chance = random.Random(seed)
    domains = [[f"d{domain}s{number}" for number in range(switches)] for domain in range(DOMAINS)]
    joined: dict[frozenset[str], Link] = {}

    def join(a: str, b: str) -> None:
        if a != b:
            joined.setdefault(frozenset((a, b)), Link(a, b, chance.randint(5, 20)))

    for nodes in domains:
        for number in range(1, switches):
            join(nodes[number], nodes[chance.randrange(number)])
        for _ in range(switches // 2):
            join(chance.choice(nodes), chance.choice(nodes))
    for number in range(1, DOMAINS):
        for other in (0, chance.randrange(number)):
            join(chance.choice(domains[number]), chance.choice(domains[other]))
    return Topology(
        tuple(joined.values()),
        tuple(DomainPlan(f"d{n}", tuple(nodes), upper="d0" if n else None) for n, nodes in enumerate(domains)),
        tuple(Attachment(nodes[0], "rib", "rib") for nodes in domains)
        + tuple(Attachment(nodes[-1], "proxy", "proxy") for nodes in domains),
    )


@pytest.mark.parametrize("switches", [5, *nightly(8, 25)])
def test_up_to_two_hundred_switches_settle_and_deliver(switches: int) -> None:
    world = Simulation(topology=wide(switches), hello_s=5.0, dead_s=18.0, lease_s=5.0, keepalive_ms=4_000)
    assert len(world.switches) == DOMAINS * switches
    assert world.run_until_attached(30)
    source, label, other = (f"d{domain}s{switches - 1}/proxy" for domain in (1, DOMAINS - 1, 4))
    flow = flowing(world, source=source, readers=(label, other))
    flow.stream(20, 0.01)
    assert world.network.run(10, lambda: flow.has(label, 20) and flow.has(other, 20))
    assert flow.numbers(label) == list(range(20))
    flow.outlive()
