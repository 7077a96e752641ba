"""Two hundred switches in eight domains: they discover each other, and a message reaches its reader."""

from __future__ import annotations

import random

from gdp.simulation.simulation import Simulation
from gdp.simulation.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import flowing

DOMAINS, SWITCHES = 8, 25


def wide(seed: int = 1) -> Topology:
    """Return domains that are each a random tree with some more links, joined to the first and to some others.

    The first is the tier above all the others; each has its RIB at its first switch, and a proxy at its last.
    """
    chance = random.Random(seed)
    domains = [[f"d{domain}s{number}" for number in range(SWITCHES)] for domain in range(DOMAINS)]
    joined: dict[frozenset[str], Link] = {}

    def join(a: str, b: str) -> None:
        if a != b:
            joined.setdefault(frozenset((a, b)), Link(a, b, chance.randint(5, 20)))

    for nodes in domains:
        for number in range(1, SWITCHES):
            join(nodes[number], nodes[chance.randrange(number)])
        for _ in range(SWITCHES // 2):
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


def test_two_hundred_switches_settle_and_deliver() -> None:
    world = Simulation(topology=wide(), hello_s=5.0, dead_s=18.0, lease_s=5.0)
    assert len(world.switches) == 200
    assert world.run_until_attached(30)
    label = f"d{DOMAINS - 1}s{SWITCHES - 1}/proxy"
    flow = flowing(world, source="d1s24/proxy", readers=(label, "d4s24/proxy"))
    flow.stream(20, 0.01)
    assert world.network.run(10, lambda: flow.has(label, 20) and flow.has("d4s24/proxy", 20))
    assert flow.numbers(label) == list(range(20))
    flow.outlive()
