"""Networks and faults drawn at random, and the deliveries that graph and policy still require.

A drawn plan prints itself; given back to ``Trial`` it repeats the trial, keys included.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from itertools import pairwise
from typing import Final
from unittest import mock

import networkx as nx
from hypothesis import strategies as st

from gdp.intervals import JOIN, NEIGHBOUR, SoftState
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import LEASES, Flow, advertise

SWITCHES_MAX: Final = 40
DOMAINS_MAX: Final = 6
TIERS_MAX: Final = 3
LEASE_S: Final = JOIN.lease_s + 1.0  # of names and of link states, so that none is longer
_SHORT: Final = SoftState(LEASE_S / 3, periods=3)
PERIOD_S: Final = 0.5  # between messages of each publisher
SETTLE_S: Final = 40.0
_FAST_SWITCHES: Final = 8  # timers of larger networks are slower in proportion, to save time
_FAULT_S: Final = 2.0  # the first fault, from the first message on


class Fate(Enum):
    """Requirement of graph and policy on a reader."""

    ALL = "all"  # every message arrives, in order
    NONE = "none"  # nothing that was published after the faults does
    ANY = "any"  # both are right: it depends on paths that each switch chooses for itself


@dataclass(frozen=True)
class Fault:
    """Link or switch that fails for ever, ``after_s`` after the first message; ``which`` counts modulo all."""

    is_switch: bool
    which: int
    after_s: float


@dataclass(frozen=True)
class Plan:
    """Network, its members, and its faults.

    Args:
        sizes: switches of each domain.
        uppers: for each domain but the first, the domain of the tier above.
        chords: links inside domains, as (domain, switch, switch), counted modulo.
        joints: further links between domains, as (domain, switch, domain, switch), counted modulo.
        ribs: for each domain, the switch of its RIB; -1: it has none. The first has one in any case.
        members: the switches of the members, of all switches, counted modulo.
        barred: domains through which no domain lets traffic pass; none that is a tier above.
    """

    sizes: tuple[int, ...]
    uppers: tuple[int, ...]
    chords: tuple[tuple[int, int, int], ...]
    joints: tuple[tuple[int, int, int, int], ...]
    ribs: tuple[int, ...]
    members: tuple[int, ...]
    barred: frozenset[int]
    faults: tuple[Fault, ...]
    seed: int

    def topology(self) -> Topology:
        """Return its topology: each domain a ring with chords, joined to the tier above at two of its switches."""
        domains = [[f"d{d}s{s}" for s in range(size)] for d, size in enumerate(self.sizes)]
        links: dict[frozenset[str], Link] = {}

        def join(a: str, b: str) -> None:
            if a != b:
                cost = 5 + hashlib.sha256(f"{self.seed}{sorted((a, b))}".encode()).digest()[0] % 16
                links.setdefault(frozenset((a, b)), Link(a, b, cost))

        for nodes in domains:
            for a, b in pairwise([*nodes, nodes[0]]):
                join(a, b)
        for domain, one, two in self.chords:
            nodes = domains[domain % len(domains)]
            join(nodes[one % len(nodes)], nodes[two % len(nodes)])
        for number, upper in enumerate(self.uppers, start=1):
            own, upstream = domains[number], domains[upper]
            join(own[0], upstream[number % len(upstream)])
            join(own[-1], upstream[(number + len(upstream) // 2) % len(upstream)])
        for domain, one, other, two in self.joints:
            own, far = domains[domain % len(domains)], domains[other % len(domains)]
            join(own[one % len(own)], far[two % len(far)])
        everywhere = [node for nodes in domains for node in nodes]
        return Topology(
            tuple(links.values()),
            tuple(
                DomainPlan(f"d{d}", tuple(nodes), upper=f"d{self.uppers[d - 1]}" if d else None)
                for d, nodes in enumerate(domains)
            ),
            (
                *(
                    Attachment(nodes[rib % len(nodes)], "rib", "rib")
                    for d, (nodes, rib) in enumerate(zip(domains, self.ribs, strict=True))
                    if rib >= 0 or d == 0
                ),
                *(
                    Attachment(everywhere[at % len(everywhere)], "proxy", f"m{number}")
                    for number, at in enumerate(self.members)
                ),
            ),
        )

    def transits(self, topology: Topology) -> dict[str, tuple[str, ...]]:
        """Return the domains through which each lets its traffic pass."""
        open_to_all = tuple(f"d{d}" for d in range(len(self.sizes)) if d not in self.barred)
        return {each.label: open_to_all for each in topology.domains}


def draw_uppers(draw: st.DrawFn, domains: int, tiers_max: int) -> list[int]:
    """Draw the domain of the tier above for each domain but the first."""
    uppers: list[int] = []
    tier = [1]
    for number in range(1, domains):
        upper = draw(st.sampled_from([d for d in range(number) if tier[d] < tiers_max]))
        uppers.append(upper)
        tier.append(tier[upper] + 1)
    return uppers


@st.composite
def plans(draw: st.DrawFn, faults_max: int = 2) -> Plan:
    """Draw a plan."""
    domains = draw(st.integers(1, DOMAINS_MAX))
    sizes = tuple(draw(st.integers(1, 9)) for _ in range(domains))
    lacking = max(5 - sum(sizes), 0)
    sizes = (sizes[0] + lacking, *sizes[1:])
    while sum(sizes) > SWITCHES_MAX:
        sizes = tuple(max(size - 1, 1) for size in sizes)
    uppers = draw_uppers(draw, domains, TIERS_MAX)
    index = st.integers(0, SWITCHES_MAX - 1)
    may_be_barred = sorted(set(range(domains)) - set(uppers) - {0})
    barred = draw(st.sets(st.sampled_from(may_be_barred), max_size=1)) if may_be_barred else set()
    return Plan(
        sizes,
        tuple(uppers),
        tuple(draw(st.lists(st.tuples(index, index, index), max_size=6))),
        tuple(draw(st.lists(st.tuples(index, index, index, index), max_size=4))),
        tuple(draw(st.integers(-1, 8)) if not barred else draw(st.integers(0, 8)) for _ in range(domains)),
        tuple(draw(st.lists(index, min_size=2, max_size=3))),
        frozenset(barred),
        tuple(
            Fault(draw(st.booleans()), draw(st.integers(0, 200)), draw(st.sampled_from([0.0, 0.1, 3.0])) + _FAULT_S)
            for _ in range(draw(st.integers(1, faults_max)))
        ),
        draw(st.integers(1, 1_000)),
    )


@contextmanager
def short_leases() -> Iterator[None]:
    """Make no lease longer than ``LEASE_S``."""
    with (
        mock.patch("gdp.switch.lsdb.LINK_STATE", _SHORT),
        mock.patch("gdp.switch.flooding.LINK_STATE", _SHORT),
    ):
        yield


@dataclass
class Trial:
    """One plan, run for longer than three of its leases after the last fault."""

    plan: Plan
    topology: Topology = field(init=False)
    world: Simulation = field(init=False)
    dead: set[str] = field(default_factory=set)
    cut: set[frozenset[str]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.topology = self.plan.topology()
        slower = max(1.0, len(self.topology.nodes) / _FAST_SWITCHES)
        self.world = Simulation(
            topology=self.topology,
            seed=self.plan.seed,
            hello_s=NEIGHBOUR.refresh_s * slower,
            dead_s=NEIGHBOUR.lease_s * slower,
            lease_s=LEASE_S,
            transits=self.plan.transits(self.topology),
        )

    def run(self) -> None:
        """Let all members publish to all others, inject the faults, and check the deliveries."""
        assert self.world.run_until_attached(SETTLE_S), "not every member is attached"
        flows = [self._established(label) for label in self.world.members]
        count = int((self._faults_end_s() + LEASES * LEASE_S) / PERIOD_S)
        for flow in flows:
            flow.stream(count, PERIOD_S, size=50)
        for fault in self.plan.faults:
            self.world.network.call(fault.after_s, partial(self._fail, fault))
        self.world.network.run(count * PERIOD_S + 3.0)
        self._collect(flows)
        for flow in flows:
            for label in flow.got:
                self._check(flow, label, count)
        self._check_late()

    def fate(self, source: str, reader: str) -> Fate:
        """Return the requirement on a flow from one member to another after the faults."""
        start, end = (label.split("/", maxsplit=1)[0] for label in (reader, source))
        return self._fate(start, end)

    def _fate(self, start: str, end: str) -> Fate:
        if {start, end} & self.dead:
            return Fate.NONE
        own, far = (self.topology.domain_of(each).label for each in (start, end))
        barred = {f"d{d}" for d in self.plan.barred} - {own, far}
        left: nx.Graph[str] = nx.Graph()
        left.add_nodes_from(set(self.topology.nodes) - self.dead)
        for link in self.topology.links:
            if link.ends() not in self.cut and not link.ends() & self.dead:
                left.add_edge(link.a, link.b, weight=link.cost)
        for node in [each for each in left if self.topology.domain_of(each).label in barred]:
            left.remove_node(node)
        if not nx.has_path(left, start, end):
            return Fate.NONE
        if own == far or f"d{own[1:]}" not in {f"d{d}" for d in self.plan.barred}:
            return Fate.ALL
        for path in nx.all_shortest_paths(left, start, end, weight="weight"):
            inside = [self.topology.domain_of(each).label == own for each in path]
            if any(after and not before for before, after in pairwise(inside)):
                return Fate.ANY  # out of a barred domain and in again: those outside do not let it pass
        return Fate.ALL

    def _established(self, source: str) -> Flow:
        flow = advertise(self.world, f"/from/{source}", source)
        others = [label for label in self.world.members if label != source]
        for label in others:
            flow.read_by(label)
        assert self.world.network.run(SETTLE_S, lambda: flow.is_read_by(len(others))), f"not all read {source}"
        return flow

    def _faults_end_s(self) -> float:
        return max(fault.after_s for fault in self.plan.faults)

    def _fail(self, fault: Fault) -> None:
        if fault.is_switch:
            node = self.topology.nodes[fault.which % len(self.topology.nodes)]
            self.dead.add(node)
            self.world.network.stop(node)
        else:
            link = self.topology.links[fault.which % len(self.topology.links)]
            self.cut.add(link.ends())
            self.world.network.set_link(self.world.cables[link.ends()], up=False)

    def _collect(self, flows: list[Flow]) -> None:
        """Poll the received messages of each member, which reads several of the flows."""
        of = {flow.topic.name: flow for flow in flows}
        for label, member in self.world.members.items():
            for each in member.poll_messages():
                of[each.topic].got[label].append(each.delivered)

    def _check(self, flow: Flow, label: str, count: int) -> None:
        numbers = [int.from_bytes(each.message[:4], "big") for each in flow.got[label]]
        fate = self.fate(flow.source, label)
        reported = f"{flow.source} to {label}, {fate.value}: {len(numbers)} of {count}, the last of them {numbers[-1:]}"
        assert numbers == sorted(set(numbers)), f"doubled or out of order: {reported}"
        if fate is Fate.ALL:
            assert numbers == list(range(count)), reported
        elif fate is Fate.NONE:
            assert max(numbers, default=0) * PERIOD_S <= self._faults_end_s() + PERIOD_S, reported

    def _check_late(self) -> None:
        """Check that members that join after the faults find their names, if every RIB still exists for them."""
        first, *_, last = self.world.members
        places = {self.topology.domain_of(at.switch).label: at.switch for at in self.topology.attached("rib")}
        asks = [(place, places[upper]) for label, place in places.items() if (upper := self._upper(label)) in places]
        for member in (first, last):
            switch = member.split("/", maxsplit=1)[0]
            domain = self.topology.domain_of(switch).label
            asks.append((switch, places.get(domain, switch)))
            if domain not in places:
                asks += [(switch, place) for place in places.values()]
        if any(self._fate(*each) is not Fate.ALL for each in asks) or self.fate(first, last) is not Fate.ALL:
            return
        flow = advertise(self.world, "/late", first)
        flow.read_by(last)
        assert self.world.network.run(20.0, lambda: flow.is_read_by(1)), f"{last} does not find what {first} publishes"

    def _upper(self, label: str) -> str | None:
        return next(each.upper for each in self.topology.domains if each.label == label)
