"""Trees of domains drawn at random, whose RIBs die: no established flow may notice.

A drawn plan prints itself; given back to ``Trial`` it repeats the trial, keys and the order of names included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Final

from hypothesis import strategies as st

from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity, NodeKeys
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import LEASES, Flow, advertise
from tests.journeys.networks import LEASE_S, PERIOD_S, SETTLE_S, draw_uppers

DOMAINS_MAX: Final = 12
TIERS_MAX: Final = 4


@dataclass(kw_only=True)
class OrderedSimulation(Simulation):
    """Simulation whose RIBs have names in a given order.

    Attributes:
        ranks: for a RIB's node label, ``switch/device``, its place in the order of names, 0 to 15.
    """

    ranks: Mapping[str, int]

    def identity(self, role: Role, label: str, domain: str) -> Identity:
        """Return the identity of a node; a RIB's key is drawn until its name begins with its rank."""
        while role is Role.RIB and label in self.ranks and label not in self.identities:
            keys = NodeKeys.generate(role, label.replace("/", "-"), key=self._key())
            identity = keys.join(self.authorities[domain], self.validity)
            if identity.name[0] >> 4 == self.ranks[label]:
                self.identities[label] = identity
        return super().identity(role, label, domain)


@dataclass(frozen=True)
class Death:
    """A RIB that dies for ever; ``which`` counts modulo all."""

    which: int
    after_s: float


@dataclass(frozen=True)
class Plan:
    """Tree of domains, its flows, and the RIBs that die.

    Args:
        uppers: for each domain but the first, the domain of the tier above.
        sizes: switches of each domain, in a row; the tier above joins the first one.
        ribs: RIBs of each domain, 0 to 2; the first has one in any case.
        joints: further links between domains, as (domain, domain), counted modulo.
        order: the RIBs, counted modulo those that remain, in the order of their names.
        flows: publisher's and reader's domain, counted modulo; and whether another flow goes back.
    """

    uppers: tuple[int, ...]
    sizes: tuple[int, ...]
    ribs: tuple[int, ...]
    joints: tuple[tuple[int, int], ...]
    order: tuple[int, ...]
    flows: tuple[tuple[int, int, bool], ...]
    deaths: tuple[Death, ...]
    lease_s: float = LEASE_S
    seed: int = 1

    def pairs(self) -> list[tuple[int, int]]:
        """Return the domains of publisher and reader of each flow."""
        count = len(self.sizes)
        found: dict[tuple[int, int], None] = {}
        for source, reader, is_both in self.flows:
            ends = source % count, reader % count
            found |= dict.fromkeys([ends, ends[::-1]] if is_both else [ends])
        return list(found)

    def topology(self) -> Topology:
        """Return its topology; the member of a domain is attached to its last switch."""
        domains = [[f"d{d}s{s}" for s in range(size)] for d, size in enumerate(self.sizes)]
        links = {frozenset(ends): Link(*ends) for nodes in domains for ends in pairwise(nodes)}
        tree = [(domains[number][0], domains[upper][-1]) for number, upper in enumerate(self.uppers, start=1)]
        cross = [(domains[a % len(domains)][-1], domains[b % len(domains)][-1]) for a, b in self.joints]
        for a, b in tree + [(a, b) for a, b in cross if a != b]:
            links.setdefault(frozenset((a, b)), Link(a, b))
        with_members = sorted({domain for pair in self.pairs() for domain in pair})
        return Topology(
            tuple(links.values()),
            tuple(
                DomainPlan(f"d{d}", tuple(nodes), upper=f"d{self.uppers[d - 1]}" if d else None)
                for d, nodes in enumerate(domains)
            ),
            (
                *(
                    Attachment(nodes[number % len(nodes)], "rib", f"rib{number}")
                    for nodes, ribs in zip(domains, (max(self.ribs[0], 1), *self.ribs[1:]), strict=True)
                    for number in range(ribs)
                ),
                *(Attachment(domains[domain][-1], "proxy", "pub") for domain in with_members),
                *(Attachment(domains[domain][-1], "proxy", "sub") for domain in with_members),
            ),
        )


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Draw a plan: 3 to 12 domains in 2 to 4 tiers."""
    count = draw(st.integers(3, DOMAINS_MAX))
    uppers = draw_uppers(draw, count, TIERS_MAX)
    index = st.integers(0, DOMAINS_MAX - 1)
    return Plan(
        tuple(uppers),
        tuple(draw(st.integers(1, 2)) for _ in range(count)),
        tuple(draw(st.sampled_from([1, 1, 1, 0, 2])) for _ in range(count)),
        tuple(draw(st.lists(st.tuples(index, index), max_size=2))),
        tuple(draw(st.permutations(range(min(count, 6))))),
        tuple(draw(st.lists(st.tuples(index, index, st.booleans()), min_size=1, max_size=3))),
        tuple(
            Death(draw(st.integers(0, 2 * DOMAINS_MAX)), draw(st.sampled_from([0.2, 0.25, 1.0, 3.3, 9.0])))
            for _ in range(draw(st.integers(1, 6)))
        ),
        draw(st.sampled_from([LEASE_S, 2.0])),
        draw(st.integers(1, 1_000)),
    )


@dataclass
class Trial:
    """One plan, run for more than three leases after the last death."""

    plan: Plan
    world: OrderedSimulation = field(init=False)

    def __post_init__(self) -> None:
        topology = self.plan.topology()
        left = [f"{at.switch}/{at.ifname}" for at in topology.attached("rib")]
        order = [left.pop(which % len(left)) for which in self.plan.order if left] + left
        ranks = {label: min(rank, 15) for rank, label in enumerate(order)}
        self.world = OrderedSimulation(topology=topology, seed=self.plan.seed, lease_s=self.plan.lease_s, ranks=ranks)

    def run(self) -> None:
        """Publish on every flow, let RIBs die, and check that each message arrives, in order."""
        world = self.world
        assert world.run_until_attached(SETTLE_S), "not every member is attached"
        flows = [self._established(*pair) for pair in self.plan.pairs()]
        end_s = max(death.after_s for death in self.plan.deaths) + LEASES * LEASE_S  # of joins, which none outlasts
        count = int(end_s / PERIOD_S)
        for flow in flows:
            flow.stream(count, PERIOD_S, size=50)
        labels = list(world.ribs)
        for death in self.plan.deaths:
            world.network.call(death.after_s, partial(world.kill_rib, labels[death.which % len(labels)]))
        world.network.run(count * PERIOD_S + 3.0)
        of = {flow.topic.name: flow for flow in flows}
        for label, member in world.members.items():
            for each in member.poll_messages():
                of[each.topic].got[label].append(each.delivered)
        complaints = [
            f"{flow.source} to {label}: {lack}"
            for flow in flows
            for label in flow.got
            if (lack := self._lack(flow, label, count))
        ]
        assert not complaints, complaints

    def _established(self, source: int, reader: int) -> Flow:
        publisher, subscriber = (
            f"{self._last(domain)}/{device}" for domain, device in ((source, "pub"), (reader, "sub"))
        )
        flow = advertise(self.world, f"/d{source}/d{reader}", publisher)
        flow.read_by(subscriber)
        assert self.world.network.run(SETTLE_S, lambda: flow.is_read_by(1)), f"{subscriber} does not read {publisher}"
        return flow

    def _last(self, domain: int) -> str:
        return f"d{domain}s{self.plan.sizes[domain] - 1}"

    @staticmethod
    def _lack(flow: Flow, label: str, count: int) -> str:
        numbers = [int.from_bytes(each.message[:4], "big") for each in flow.got[label]]
        missing = sorted(set(range(count)) - set(numbers))
        if missing or numbers != sorted(set(numbers)):
            return f"{len(numbers)} of {count}, missing from {missing[:1]} on"
        return ""
