"""Machines without their border: direct pairs go on, all others come back with it, and each loss is reported.

NATs, kills and restarts are drawn. A topic of each machine is read by both others, and each calls a service of the next
one, so that direct, relayed and mixed pairs share a publisher.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import permutations
from typing import Final

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.intervals import DETECT_MULTIPLIER, OWING, SCAPY_KEEPALIVE_MS
from gdp.names import Name
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.draws import draws
from tests.gdp.switch.nat import Nat, permits
from tests.journeys.flows import LEASE_S, LEASES, Flow, advertise
from tests.journeys.services import Party, meet, outlive, work
from tests.journeys.tunnelled import BORDER, SITES, Tunnelled, tunnelled
from tests.lanes import long_example

STEP_S, LATE_S, LOOK_S, SETTLE_S = 0.25, 1.0, 0.05, 40.0
LEASES_S: Final = LEASES * LEASE_S
DEAD_S: Final = DETECT_MULTIPLIER * SCAPY_KEEPALIVE_MS / 1e3
DETECT_S: Final = OWING.lease_s  # of a dead neighbour, by keepalives
FIRST_S: Final = 1.0  # the first fault, after the first message
RIBS: Final = ("lab", "lab#2")
PROGRAMS: Final = {"border": (BORDER, *RIBS), "switch of the border": (BORDER,), "RIB": RIBS[:1], "other RIB": RIBS[1:]}
Pair = tuple[str, str]


@dataclass(frozen=True)
class Fault:
    """Programs that are killed, ``at_s`` after the first fault is possible, and restarted ``lasts_s`` later."""

    what: str
    at_s: float
    lasts_s: float


@dataclass(frozen=True)
class Drawn:
    """NATs of the machines (None: UDP is blocked there), place of the second RIB, the faults, and the leaves."""

    nats: tuple[Nat | None, ...]
    other_rib: str
    faults: tuple[Fault, ...]
    leaves: frozenset[str] = frozenset()
    seed: int = 1


def _drawn() -> st.SearchStrategy[Drawn]:
    nats = st.tuples(*(st.sampled_from([*Nat, None]) for _ in SITES))
    faults = st.builds(
        Fault,
        st.sampled_from([*PROGRAMS, "relay", *SITES]),
        st.floats(0.0, LEASES_S),
        st.sampled_from([0.5, LEASE_S, LEASES_S]),
    )
    places = st.sampled_from([BORDER, *SITES])
    several = st.lists(faults, min_size=1, max_size=3).map(tuple)
    leaves = st.sampled_from([frozenset(), frozenset(SITES[:1]), frozenset(SITES)])
    return st.builds(Drawn, nats, places, several, leaves, st.integers(1, 1_000))


@dataclass
class Traffic:
    """Topics and calls between all machines, with the second at which each message was read or answered.

    Attributes:
        read: by source and reader: the numbers that came, each with how late it was.
        answered: by client and server, likewise.
    """

    bed: Tunnelled
    flows: dict[str, Flow] = field(init=False)
    clients: dict[Pair, Party] = field(init=False)
    servers: dict[str, Party] = field(init=False)
    read: dict[Pair, list[tuple[int, float]]] = field(default_factory=dict)
    answered: dict[Pair, list[tuple[int, float]]] = field(default_factory=dict)
    sent_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        world = self.bed.world
        self.flows = {each: advertise(world, f"/{each}", f"{each}/member") for each in SITES}
        self.servers = {each: Party(world, f"{each}/member", Right.SERVE, f"/serve {each}") for each in SITES}
        nexts = list(zip(SITES, (*SITES[1:], SITES[0]), strict=True))
        self.clients = {pair: Party(world, f"{pair[0]}/member", Right.CALL, f"/serve {pair[1]}") for pair in nexts}
        for source, reader in permutations(SITES, 2):
            self.flows[source].read_by(f"{reader}/member")
            self.read[source, reader] = []
        for pair in nexts:
            self.answered[pair] = []
            assert meet(world, self.clients[pair], self.servers[pair[1]], within_s=10.0)
        assert world.network.run(10, lambda: all(flow.is_read_by(2) for flow in self.flows.values()))

    def send(self) -> None:
        """Publish the next message of each topic, and the next request of each client."""
        self.sent_s.append(self.bed.network.now.mono_s)
        number = b"%d" % (len(self.sent_s) - 1)
        for flow in self.flows.values():
            flow.publish(number)
        for client in self.clients.values():
            client.publish(number)

    def collect(self) -> None:
        """Read and answer what came."""
        now_s, names = self.bed.network.now.mono_s, {flow.topic.name: at for at, flow in self.flows.items()}
        for site in SITES:
            messages = self.bed.world.members[f"{site}/member"].poll_messages()
            for each in messages:
                body = each.delivered.message
                number = int(body.split(b" ")[0])
                came = number, now_s - self.sent_s[number]
                if each.topic in names:
                    self.read[names[each.topic], site].append(came)
                elif each.topic == self.servers[site].service:
                    self.servers[site].answer(Name(each.delivered.publisher), body + b" by")
                else:
                    self.answered[next(pair for pair in self.clients if pair[0] == site)].append(came)

    def send_for(self, duration_s: float) -> None:
        """Let all publish and call at a steady rate from now on."""
        for step in range(round(duration_s / STEP_S)):
            self.bed.network.call(step * STEP_S, self.send)

    def run(self, duration_s: float) -> None:
        """Collect for a time."""
        for _ in range(round(duration_s / LOOK_S)):
            self.bed.network.run(LOOK_S)
            self.collect()

    def is_complete(self) -> bool:
        """Return whether the last message and the last answer came everywhere."""
        return all(came and came[-1][0] == len(self.sent_s) - 1 for came in (self.read | self._all_answered()).values())

    def _all_answered(self) -> dict[Pair, list[tuple[int, float]]]:
        return {(f"{one} calls", other): came for (one, other), came in self.answered.items()}

    def check(self, direct: set[Pair]) -> None:
        """Assert that nothing came twice or late between these pairs, and that each reader reports what it lacks."""
        for (source, reader), came in self.read.items():
            numbers = [number for number, _ in came]
            assert numbers == sorted(set(numbers)), f"{source} to {reader}"
            member = self.bed.world.members[f"{reader}/member"]
            lost = member.subscriptions.losses_of(self.flows[source].topic.name).total
            assert lost == len(self.sent_s) - len(numbers), f"{source} to {reader}: lost without a report"
        for pair, came in (*self.read.items(), *self.answered.items()):
            if pair in direct:
                assert [number for number, _ in came] == list(range(len(self.sent_s))), pair
                assert max(late_s for _, late_s in came) < LATE_S, pair


def _kill(bed: Tunnelled, fault: Fault) -> None:
    if fault.what == "relay":
        _set_relays(bed, is_up=False)
    else:
        bed.kill(*PROGRAMS.get(fault.what, (fault.what,)))


def _restart(bed: Tunnelled, fault: Fault) -> None:
    if fault.what == "relay":
        _set_relays(bed, is_up=True)
    else:
        bed.restart(*PROGRAMS.get(fault.what, (fault.what,)))


def _set_relays(bed: Tunnelled, *, is_up: bool) -> None:
    for link in bed.relays:
        bed.network.set_link(link, up=is_up)


def _traffic(bed: Tunnelled, direct: set[Pair]) -> Traffic:
    """Return traffic that begins when these tunnels are up."""
    assert bed.network.run(60, lambda: all(bed.is_direct(*pair) for pair in direct))
    return Traffic(bed)


KILLED: Final = (Fault("border", 0.0, LEASES_S),)


@pytest.mark.momentary(
    "every trial publishes for three leases after its last fault; hypothesis also draws shorter ones"
)
@draws(1, long=8)
@given(_drawn())
@long_example(Drawn((Nat.PORT, Nat.PORT, None), BORDER, KILLED))
@example(Drawn((Nat.PORT, Nat.PORT, Nat.PORT), BORDER, KILLED, frozenset(SITES)))
@long_example(Drawn((Nat.SYMMETRIC, Nat.FULL_CONE, Nat.PORT), BORDER, KILLED))
@example(Drawn((Nat.PORT, Nat.PORT, Nat.SYMMETRIC), "a", (*KILLED, Fault("c", 1.0, 0.5))))
def test_direct_pairs_outlive_their_border_and_all_others_return_with_it(drawn: Drawn) -> None:
    nats = dict(zip(SITES, drawn.nats, strict=True))
    with tunnelled(nats, drawn.other_rib, drawn.leaves, drawn.seed) as bed:
        direct = {
            (one, other)
            for one, other in permutations(SITES, 2)
            if (a := nats[one]) is not None and (b := nats[other]) is not None and permits(a, b)
        }
        traffic = _traffic(bed, direct)
        last_s = FIRST_S + max(fault.at_s + fault.lasts_s for fault in drawn.faults)
        for fault in drawn.faults:
            bed.network.call(FIRST_S + fault.at_s, partial(_kill, bed, fault))
            bed.network.call(FIRST_S + fault.at_s + fault.lasts_s, partial(_restart, bed, fault))
        traffic.send_for(last_s + LEASES_S)
        traffic.run(last_s + LEASES_S)
        for _ in range(round(SETTLE_S)):
            if traffic.is_complete():
                break
            traffic.run(1.0)
        touched = {fault.what for fault in drawn.faults}
        traffic.check({pair for pair in direct if not touched & set(pair)})
        assert traffic.is_complete(), {pair: came[-1:] for pair, came in (traffic.read | traffic.answered).items()}


def test_two_machines_with_a_direct_tunnel_to_a_third_reach_each_other_through_it_without_the_border() -> None:
    with tunnelled({"a": Nat.SYMMETRIC, "b": Nat.FULL_CONE, "c": Nat.PORT}) as bed:
        traffic = _traffic(bed, {("a", "b"), ("b", "c")})
        bed.kill(*PROGRAMS["border"])
        bed.network.run(LATE_S + DEAD_S)
        traffic.send_for(LEASES_S)
        traffic.run(LEASES_S + LATE_S)
        traffic.check(set(permutations(SITES, 2)))


def test_a_machine_that_lost_the_border_alone_keeps_its_port_and_reaches_the_others_through_its_peer() -> None:
    with tunnelled({"a": Nat.PORT, "b": Nat.PORT, "c": None}) as bed:
        traffic = _traffic(bed, {("a", "b")})
        bed.link("a", BORDER).passes = lambda _: False
        bed.network.run(LATE_S + DEAD_S)
        traffic.send_for(LEASES_S)
        traffic.run(LEASES_S + LATE_S)
        traffic.check(set(permutations(SITES, 2)))
        assert bed.machines["a"].rebinds == 0
        assert bed.world.switches["a"].rib is not None


SHORT_S: Final = 2.0  # lease of the names of an application that states its own


@pytest.mark.parametrize("holder", ["a", "b"])
def test_calls_go_on_if_the_border_dies_when_the_leases_known_from_its_rib_are_closest_to_their_end(
    holder: str,
) -> None:
    links = (Link("a", "b"), Link("a", BORDER), Link("b", BORDER))
    plan = Topology(links, (DomainPlan("lab", ("a", "b", BORDER)),), (Attachment(BORDER, "rib", "rib"),))
    world = Simulation(topology=plan, keepalive_ms=None)
    world.lease_s = SHORT_S  # of the members; the switches keep theirs
    for each in ("a", "b"):
        world.add_member(f"{each}/member", each)
    assert world.run_until_attached()
    client, server = Party(world, "a/member", Right.CALL), Party(world, "b/member", Right.SERVE)
    assert meet(world, client, server)
    known, network = world.switches[holder].state.resolver.cache, world.network

    def is_at_its_end() -> bool:
        """Return whether some location is known, and one lease ends before the loss of the border is noticed."""
        ends_s = [each.expires_s for each in known.all()]
        return bool(ends_s) and min(ends_s) - network.now.mono_s < DETECT_S

    client.publish(b"before")
    assert work(world, server, client, until_s=1.0, have=1)
    network.run(3 * SHORT_S, is_at_its_end)
    network.stop(BORDER)
    world.kill_rib("lab")
    outlive(world, client, server)
