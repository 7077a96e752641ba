"""Two paths: of a topic that asks for them, a cut link delays no message, and no frame circles."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import networkx as nx
import pytest

from gdp.control.join import Join, RouteLink
from gdp.crypto.statements import parse
from gdp.errors import StatementError
from gdp.frame.codec import ETHER_BYTES, SECOND_PATH, Kind, decode, second_path_key
from gdp.intervals import JOIN
from gdp.names import ZERO, Name
from gdp.switch.join_handler import reader_of
from gdp.switch.trees import Tree
from gdp.trust.right import Right
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import Flow
from tests.lanes import nightly

pytestmark = pytest.mark.momentary("a cut, and the seconds before and after it, are what these tests are about")

PERIOD_S = 0.05
LATE_S = 0.03  # above every path's delay, below every detection and every report
SETTLE_S = 4.0
Cables = list[tuple[str, str, SimLink]]


@dataclass
class Site:
    """Switches joined by links, some of them parallel, a publisher at the first one and readers at others."""

    world: Simulation
    cables: Cables
    copies: Counter[tuple[str, str, int, int]] = field(default_factory=Counter)  # by link, number, path
    reports: Counter[tuple[str, str, int]] = field(default_factory=Counter)  # AckNacks, by link and path

    def tap(self, _at_s: float, a: str, b: str, frame: bytes) -> None:
        """Count the copies of each message, and of reports, on each link between switches."""
        header = decode(frame, ETHER_BYTES)
        if "/" in a + b:
            return
        if header.kind == Kind.DATA:
            self.copies[a, b, header.number, header.hops_left & SECOND_PATH] += 1
        elif header.kind == Kind.ACKNACK:
            self.reports[a, b, header.hops_left & SECOND_PATH] += 1

    def trees(self, topic: Name, path: int) -> dict[str, Tree]:
        """Return the trees of a topic at each switch."""
        found = {}
        for label, switch in self.world.switches.items():
            for tree in switch.multicast.trees.of_topic(topic):
                if tree.path == path:
                    found[label] = tree
        return found


def site(links: list[tuple[str, str, int]], readers: tuple[str, ...], source: str = "s0", **more: object) -> Site:
    """Return a settled network; the same two switches may have several links."""
    nodes = sorted({node for link in links for node in link[:2]})
    first = {frozenset(link[:2]): link for link in reversed(links)}
    members = [Attachment(source, "proxy", "robot"), *(Attachment(each, "proxy", f"r{each}") for each in readers)]
    topology = Topology(
        tuple(Link(*link) for link in first.values()),
        (DomainPlan("home", tuple(nodes)),),
        (Attachment(nodes[0], "rib", "rib"), *members),
    )
    world = Simulation(topology=topology, **more)  # type: ignore[arg-type]
    cables: Cables = []
    for link in links:
        if first[frozenset(link[:2])] is link:
            cables.append((link[0], link[1], world.cables[frozenset(link[:2])]))
        else:
            cables.append((link[0], link[1], world.network.connect(link[0], link[1], SimLink(world.delay_s), link[2])))
    found = Site(world, cables)
    world.network.taps.append(found.tap)
    assert world.run_until_attached()
    return found


def flow_of(
    at: Site, readers: tuple[str, ...], source: str = "s0", *, paths: int = 2, asked: int = 2, reliable: bool = False
) -> Flow:
    """Return a topic over two paths, its trees settled; best-effort, so that nothing is repaired."""
    world, label = at.world, f"{source}/robot"
    member = world.members[label]
    topic = world.topic("/camera", member, [Right.PUBLISH])
    publisher = member.advertise(topic, b"described", reliable=reliable, paths=paths)
    world.network.send_pending(label)
    flow = Flow(world, "/camera", label, topic, publisher)
    for each in (f"{each}/r{each}" for each in readers):
        flow.got[each] = []
        world.members[each].subscribe(world.topic("/camera", world.members[each], [Right.READ]), paths=asked)
        world.network.send_pending(each)
    assert world.network.run(5, lambda: flow.is_read_by(len(readers)))
    world.network.run(SETTLE_S)
    return flow


def late(flow: Flow, count: int, first: int) -> Callable[[], list[int]]:
    """Publish ``count`` messages from number ``first`` on; return a function that lists those that were late."""
    found: list[int] = []

    def check(number: int) -> None:
        found.extend(number for label in flow.got if number not in flow.numbers(label))

    for place in range(count):
        number = first + place
        message = number.to_bytes(4, "big") + bytes(200)
        flow.world.network.call(place * PERIOD_S, partial(flow.publish, message))
        flow.world.network.call(place * PERIOD_S + LATE_S, partial(check, number))
    return lambda: found


def cut_each(at: Site, flow: Flow, cables: Cables) -> None:
    """Cut one link after another, undetected at first, and restore it; no message may be late."""
    sent = 0
    for a, b, cable in cables:
        report = late(flow, 60, sent)
        sent += 60
        at.world.network.run(1.0)
        cable.loss = 1.0
        at.world.network.run(2.5)
        cable.loss = 0.0
        at.world.network.run(SETTLE_S + 4.0)
        assert report() == [], f"after the cut of {a}-{b}"
    for label in flow.got:
        assert flow.numbers(label) == list(range(sent))
    links = len(at.cables)
    assert max(at.copies.values()) <= 2
    assert sum(at.copies.values()) <= 4 * links * sent


TWO_UPLINKS = [("s0", "s1", 10), ("s0", "s1", 12), ("s1", "s2", 10)]


def test_two_links_between_the_same_switches_carry_one_copy_each() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",))
    at.copies.clear()
    flow.stream(1, PERIOD_S, size=100)
    at.world.network.run(1.0)
    assert sum(count for key, count in at.copies.items() if key[:2] == ("s0", "s1")) == 2
    trees = [at.trees(flow.topic.name, path)["s1"] for path in (1, 2)]
    assert trees[0].upstream != trees[1].upstream
    assert flow.numbers("s2/rs2") == [0]


def test_reports_to_the_publisher_take_both_paths() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",), reliable=True)
    at.reports.clear()
    flow.stream(20, PERIOD_S, size=100)
    at.world.network.run(3.0)
    assert at.reports["s1", "s0", 0] > 0
    assert at.reports["s1", "s0", SECOND_PATH] == at.reports["s1", "s0", 0]
    assert len(ports_to(at, flow, "s1")) == 2
    at.world.network.set_cost(at.cables[1][2], 9)  # now the first copies take the link of the second tree
    at.world.network.run(3.0)
    assert len(ports_to(at, flow, "s1")) == 2


def ports_to(at: Site, flow: Flow, label: str) -> set[int]:
    """Return the ports by which both copies of a frame to the publisher leave a switch."""
    entries = at.world.switches[label].table.entries
    return {entries[key][0][0] for key in (bytes(flow.member.name), second_path_key(flow.member.name))}


def test_a_cut_of_either_uplink_delays_no_message() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    cut_each(at, flow_of(at, ("s2",)), at.cables[:2])


def test_a_pair_is_found_where_the_shortest_path_blocks_it() -> None:
    links = [("s0", "s1", 1), ("s1", "s2", 1), ("s2", "s3", 1), ("s0", "s2", 3), ("s1", "s3", 3)]
    at = site(links, ("s3",))
    cut_each(at, flow_of(at, ("s3",)), at.cables)


def drawn(seed: int) -> list[tuple[str, str, int]]:
    """Return links, some parallel, of which none is a bridge."""
    rng = random.Random(seed)
    size = rng.randint(3, 6)
    while True:
        graph: nx.MultiGraph[int] = nx.MultiGraph(nx.gnm_random_graph(size, rng.randint(size - 1, 2 * size), seed=rng))
        for _ in range(rng.randint(0, 3)):
            graph.add_edge(*rng.choice([*pairwise(range(size))]))
        if nx.is_connected(graph) and not nx.has_bridges(graph):
            return [(f"s{a}", f"s{b}", rng.randint(5, 20)) for a, b in sorted(graph.edges())]


@pytest.mark.parametrize("seed", [3, 7, *nightly(1, 2, 4, 5, 6, 8)])
def test_on_any_network_without_a_bridge_a_cut_delays_no_message(seed: int) -> None:
    links = drawn(seed)
    reader = max(link[1] for link in links)
    at = site(links, (reader,), seed=seed)
    flow = flow_of(at, (reader,))
    cut_each(at, flow, random.Random(seed).sample(at.cables, 3))


def test_a_reader_that_leaves_takes_both_trees_along() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",))
    assert all(len(at.trees(flow.topic.name, path)) == 3 for path in (1, 2))
    at.world.members["s2/rs2"].unsubscribe(flow.topic.name)
    at.world.network.send_pending("s2/rs2")
    at.world.network.run(1.0)
    assert not any(at.trees(flow.topic.name, path) for path in (1, 2))


def test_the_trees_of_a_dead_reader_end_with_their_leases() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",))
    at.world.network.stop("s2")
    at.world.network.run(JOIN.lease_s + 1.0)
    assert second_path_key(flow.member.name) not in at.world.switches["s1"].table.entries
    assert not any(label != "s2" for path in (1, 2) for label in at.trees(flow.topic.name, path))
    keys = [key for label in ("s0", "s1") for key in at.world.switches[label].table.entries if len(key) == 64]
    assert not keys


@pytest.mark.parametrize(("paths", "asked"), [(1, 2), (2, 1)])
def test_there_is_a_second_tree_only_where_publisher_and_reader_ask_for_it(paths: int, asked: int) -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",), paths=paths, asked=asked)
    assert not at.trees(flow.topic.name, 2)
    assert len(at.trees(flow.topic.name, 1)) == 3


def test_over_one_path_alone_each_message_travels_once() -> None:
    at = site([("s0", "s1", 10), ("s1", "s2", 10)], ("s2",))
    flow = flow_of(at, ("s2",))
    assert not at.trees(flow.topic.name, 2)
    flow.stream(10, PERIOD_S, size=100)
    at.world.network.run(2.0)
    assert flow.numbers("s2/rs2") == list(range(10))


def test_every_reader_of_a_topic_gets_all_of_it_through_cuts_of_any_link() -> None:
    links = [("s0", "s1", 10), ("s0", "s2", 10), ("s1", "s3", 10), ("s2", "s3", 10), ("s3", "s4", 10), ("s2", "s4", 10)]
    at = site(links, ("s3", "s4"))
    cut_each(at, flow_of(at, ("s3", "s4")), [at.cables[0], at.cables[3], at.cables[5]])


def test_a_path_of_each_tree_crosses_to_another_domain_at_its_own_border() -> None:
    links = [("s0", "s1", 10), ("s0", "s2", 10), ("s1", "s3", 10), ("s2", "s4", 10), ("s3", "s5", 10), ("s4", "s5", 10)]
    topology = Topology(
        tuple(Link(*link) for link in links),
        (DomainPlan("cloud", ("s0", "s1", "s2")), DomainPlan("home", ("s3", "s4", "s5"), upper="cloud")),
        (
            Attachment("s0", "rib", "rib"), Attachment("s5", "rib", "rib"),
            Attachment("s0", "proxy", "robot"), Attachment("s5", "proxy", "rs5"),
        ),
    )  # fmt: skip
    world = Simulation(topology=topology)
    at = Site(world, [(a, b, world.cables[frozenset((a, b))]) for a, b, _ in links])
    world.network.taps.append(at.tap)
    assert world.run_until_attached(20.0)
    flow = flow_of(at, ("s5",))
    assert {path: at.trees(flow.topic.name, path).keys() & {"s3", "s4"} for path in (1, 2)} in (
        {1: {"s3"}, 2: {"s4"}},
        {1: {"s4"}, 2: {"s3"}},
    )
    cut_each(at, flow, [at.cables[2], at.cables[4]])


@pytest.mark.parametrize("wrong", ["a route that returns", "a route through the sender", "a backup", "one path asked"])
def test_a_join_with_a_wrong_route_makes_no_tree(wrong: str) -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",), asked=1 if wrong == "one path asked" else 2)
    middle = at.world.switches["s1"]
    sender, robot = (at.world.switches[label].name for label in ("s2", "s0"))
    seen = at.trees(flow.topic.name, 1)["s2"]
    neighbour = next(each for each in middle.hello_protocol.neighbours.all_up() if each.name == sender)
    route = {"a route that returns": middle.name, "a route through the sender": sender}.get(wrong, robot)
    join = Join(
        topic=flow.topic.name,
        publisher=flow.member.name,
        switch=robot,
        domain=neighbour.domain,
        allowed=frozenset({neighbour.domain}),
        mtu=1_500,
        lease_s=5.0,
        evidence=seen.evidence,
        session=bytes(16),
        sequence=1 << 62,
        version=seen.version,
        proof=seen.proof,
        path=2,
        route=(RouteLink(route, 1), RouteLink(robot, 2)) if route != robot else (RouteLink(robot, 1),),
        backup_for=sender if wrong == "a backup" else ZERO,
    )
    now = at.world.network.now
    check: Callable[[], object] = partial(middle.multicast.join, join, neighbour, now.mono_s)
    if wrong == "one path asked":
        check = partial(reader_of, join, middle.state.verifier, now)
    with pytest.raises(StatementError):
        check()


def test_a_statement_with_a_switch_twice_in_its_route_is_malformed() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow = flow_of(at, ("s2",))
    tree = at.trees(flow.topic.name, 2)["s2"]
    link = RouteLink(Name(b"a" * 32), 1)
    for route in ((link, link), (link,) * 40, (RouteLink(ZERO, 1),), (RouteLink(link.name, 1 << 32),)):
        join = Join(
            topic=tree.topic, publisher=tree.publisher, switch=tree.switch, domain=tree.domain, allowed=tree.allowed,
            mtu=1_500, lease_s=5.0, evidence=b"", session=bytes(16), sequence=1, path=2, route=route,
        )  # fmt: skip
        identity = at.world.identities["s2"]
        statement = parse(join.to_wire(identity.name, identity.key))
        with pytest.raises(StatementError, match=r"route|'r'"):
            Join.from_fields(statement.fields)


def test_status_counts_what_the_flows_have() -> None:
    at = site(TWO_UPLINKS, ("s2",))
    flow_of(at, ("s2",))
    counts = at.world.switches["s2"].multicast.path_counts
    assert counts() == {"disjoint": 0, "shared": 1, "single": 0}
    at.world.network.set_link(at.cables[1][2], up=False)
    at.world.network.run(1.0)
    assert counts() == {"disjoint": 0, "shared": 0, "single": 1}
    assert sum(at.world.switches["s1"].multicast.path_counts().values()) == 0
