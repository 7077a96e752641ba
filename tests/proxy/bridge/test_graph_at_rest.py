"""A far graph of 100 nodes with 1,500 endpoints: what its link carries at rest, and how soon a change shows."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from unittest.mock import patch

import pytest

from gdp.intervals import FORGET_S
from gdp.ros_names import NODE_TYPE
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.endpoints.core.endpoint import Graph, Role
from tests.draws import IS_LONG, TIMES
from tests.proxy.bridge.clients import Client
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites, named
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph, Publication, Server, Subscription

REST_BITS_S = 50_000
SHOWN_S = 1.0
APPEAR_S = 8.0  # one node a tick
NODES = [f"/n{number}" for number in range(100)]
SERVICES = (
    "describe_parameters", "get_parameter_types", "get_parameters", "list_parameters", "set_parameters",
    "set_parameters_atomically", "get_type_description",
)  # fmt: skip
PATTERN = ["kind: node, name: /n*"]
HOLDS = [
    named("/n*", NODE_TYPE, "node"),
    named("/rosout"),
    named("/n0/p0"),
    named("/n0/heard"),
    *(named(f"/n0/{each}", SET_BOOL, "service") for each in SERVICES),
]  # what is not used needs no delegation: of all other names nothing crosses
LINK = frozenset(("nuc1", "nuc3"))
ONE_DOMAIN = Topology(
    (Link("nuc1", "nuc3"),),
    (DomainPlan("school", ("nuc1", "nuc3")),),
    (Attachment("nuc3", "rib", "rib"), Attachment("nuc1", "proxy", "robot"), Attachment("nuc3", "proxy", "server")),
)


def fill(graph: FakeGraph, node: str) -> None:
    """Add a node with 15 endpoints."""
    for topic in ("/rosout", "/parameter_events", *(f"{node}/p{number}" for number in range(4))):
        graph.publish(node, topic, STRING)
    for service in SERVICES:
        graph.serve(node, f"{node}/{service}", SET_BOOL, lambda raw, done: done(switched(f"got {raw[-1]}")))
    for topic in ("heard", "other"):
        graph.subscribe(node, f"{node}/{topic}", STRING, lambda _: None)


class Far:
    """A robot with many nodes, and a station that has them as far ones."""

    def __init__(self, folder: Path, topology: Topology | None, seed: int = 1, nodes: Sequence[str] = NODES) -> None:
        self.sites = Sites(folder, seed, topology, look_s=0.02)
        self.robot = self.sites.add(ROBOT, expose=PATTERN, holds=HOLDS)
        server = SERVER if topology is None else "nuc3/server"
        self.station = self.sites.add(server, imports=PATTERN, holds=HOLDS)
        self._bytes = 0
        self.sites.world.network.taps.append(self._count)
        endpoints, self.robot.graph.endpoints = self.robot.graph.endpoints, []
        for node in nodes:
            fill(self.robot.graph, node)
        self.robot.graph.endpoints = endpoints
        self.robot.graph.changed()

    def is_whole(self) -> bool:
        """Return whether all that the robot's nodes have is shown."""
        return self._shown() == self._here()

    def shows_s(self, most_s: float = 10.0) -> float:
        """Return how many seconds pass until that is so; infinity: above ``most_s``."""
        here, begun_s = self._here(), self.sites.now_s
        seen: list[object] = [None]

        def is_met() -> bool:
            before, seen[0] = seen[0], self.station.endpoint._nodes
            return before is not seen[0] and self._shown() == here

        return self.sites.now_s - begun_s if self.sites.run(most_s, is_met) else float("inf")

    def _shown(self) -> dict[str, set[tuple[Role, str]]]:
        nodes = self.station.endpoint._nodes
        return {node: {(end.role, end.name) for end in ends} for node, ends in nodes.items()}

    def _here(self) -> dict[str, set[tuple[Role, str]]]:
        here: dict[str, set[tuple[Role, str]]] = {}
        for end in self.robot.graph.ends():
            if end.node.startswith("/n"):
                here.setdefault(end.node, set()).add((end.role, end.name))
        return here

    def bits_s(self, duration_s: float = 24.0) -> float:
        """Return the rate of both directions of the link from now on."""
        self._bytes = 0
        self.sites.run(duration_s)
        return 8 * self._bytes / duration_s

    def restart(self, *, is_robot: bool) -> None:
        """Restart a proxy without its memory."""
        before = self.robot if is_robot else self.station
        self.sites.kill(before)
        self.sites.world.restart_member(before.label)
        assert self.sites.world.run_until_attached()
        again = self.sites.add(
            before.label,
            graph=before.graph,
            expose=PATTERN if is_robot else (),
            imports=() if is_robot else PATTERN,
            holds=HOLDS,
        )
        self.robot, self.station = (again, self.station) if is_robot else (self.robot, again)

    def _count(self, _now_s: float, one: str, other: str, frame: bytes) -> None:
        if {one, other} == LINK:
            self._bytes += len(frame)


def changes(far: Far, chance: random.Random) -> list[Callable[[], object]]:
    """Return changes of the robot's graph: a node begins, one ends, one gains and one loses an endpoint."""
    graph, new, old, other = far.robot.graph, f"/n{chance.randrange(100, 999)}", *chance.sample(NODES[1:30], 2)

    def end() -> None:
        ends: list[Publication | Subscription | Server] = [*graph.publications, *graph.readers, *graph.servers]
        for each in [each for each in ends if each.end.node == old]:
            each.close()

    return [
        lambda: fill(graph, new),
        lambda: graph.publish(other, f"{other}/more", STRING),
        lambda: next(each for each in graph.publications if each.end.name == f"{other}/more").close(),
        end,
    ]


@pytest.mark.parametrize("domains", [1, 2] if IS_LONG else [2])
def test_the_link_at_rest_carries_little(tmp_path: Path, domains: int) -> None:
    far = Far(tmp_path, ONE_DOMAIN if domains == 1 else None)
    assert far.shows_s() < APPEAR_S
    far.sites.run(10)
    assert far.bits_s() <= REST_BITS_S
    assert far.is_whole()


@pytest.mark.parametrize("seed", range(1, 1 + TIMES))
def test_a_change_shows_within_a_second_under_loss_and_after_restarts(tmp_path: Path, seed: int) -> None:
    far, chance = Far(tmp_path, ONE_DOMAIN, seed, NODES[:30]), random.Random(seed)
    assert far.shows_s() < APPEAR_S
    far.sites.run(10)
    link = far.sites.world.cables[LINK]
    link.loss = chance.uniform(0.01, 0.05)
    is_robot = chance.random() < 0.5
    for change in changes(far, chance):
        change()
        assert far.shows_s() <= SHOWN_S
        far.sites.run(chance.uniform(0.1, 2.0))
    far.restart(is_robot=is_robot)
    assert far.shows_s() < APPEAR_S
    for change in changes(far, chance):
        change()
        assert far.shows_s() <= SHOWN_S
    link.loss = 0.0
    far.sites.run(FORGET_S + 10)  # what the restart left behind is forgotten
    assert far.bits_s() <= REST_BITS_S


def test_what_a_local_node_uses_of_far_ones_crosses_and_nothing_else(tmp_path: Path) -> None:
    far = Far(tmp_path, ONE_DOMAIN, nodes=NODES[:3])
    robot, station, sites = far.robot, far.station, far.sites
    assert far.shows_s() < 5
    assert robot.carried == {("/n*", True)}
    ear, caller = Ear(station.graph, "/n0/p0"), Client(station.graph, "/n0/get_parameters")
    assert caller.sees_server()
    caller.call(switch(on=True))
    assert sites.run(2, lambda: caller.outcomes == [switched("got 1")])
    published = next(each for each in robot.graph.publications if each.end.name == "/n0/p0")
    published.publish(string("hello"))
    assert sites.run(2, lambda: ear.texts == ["hello"])
    assert robot.carried == {("/n*", True), ("/n0/p0", True), ("/n0/get_parameters", True)}
    ear.leave()
    assert sites.run(75, lambda: robot.carried == {("/n*", True)})
    caller.call(switch(on=False))
    assert sites.run(2, lambda: caller.outcomes[1:] == [switched("got 0")])


def test_what_far_nodes_hear_comes_while_this_machine_gives_it(tmp_path: Path) -> None:
    far = Far(tmp_path, ONE_DOMAIN, nodes=NODES[:3])
    assert far.shows_s() < 5
    heard = Ear(far.robot.graph, "/n0/heard", node="/n0")
    far.sites.reload(far.station, imports=PATTERN, expose=["name: /n0/heard"], holds=HOLDS)
    operator = far.station.graph.publish("/teleop", "/n0/heard", STRING)
    assert far.sites.run(3, lambda: ("/n0/heard", False) in far.robot.carried)
    far.sites.run(1)
    operator.publish(string("go"))
    assert far.sites.run(1, lambda: heard.texts == ["go"])
    operator.close()
    assert far.sites.run(3, lambda: ("/n0/heard", False) not in far.robot.carried)


def test_a_call_of_a_far_node_whose_machine_is_silent_ends_with_a_reason(tmp_path: Path) -> None:
    far = Far(tmp_path, ONE_DOMAIN, nodes=NODES[:3])
    assert far.shows_s() < 5
    far.sites.world.network.freeze(far.robot.label)
    caller = Client(far.station.graph, "/n0/get_parameters")
    caller.call(switch(on=True))
    assert far.sites.run(7, lambda: bool(caller.outcomes))
    assert far.station.faults.get("no-server") == 1


def test_nodes_appear_one_by_one_so_that_none_holds_up_what_is_carried(tmp_path: Path) -> None:
    far = Far(tmp_path, ONE_DOMAIN, nodes=NODES[:8])
    endpoint, counts = far.station.endpoint, list[int]()
    set_nodes = endpoint.set_nodes

    def count(nodes: Mapping[str, Graph]) -> None:
        counts.append(len(nodes))
        set_nodes(nodes)

    with patch.object(FakeEndpoint, "set_nodes", side_effect=count):
        assert far.sites.run(3, lambda: counts[-1:] == [8])
    assert counts == list(range(1, 9))


def test_a_machine_may_take_some_nodes_of_a_pattern(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    robot = sites.add(ROBOT, expose=PATTERN, holds=HOLDS)
    station = sites.add(SERVER, imports=["kind: node, name: /n0", "kind: node, name: /n2"], holds=HOLDS)
    for node in NODES[:4]:
        fill(robot.graph, node)
    assert sites.run(5, lambda: set(station.endpoint._nodes) == {"/n0", "/n2"})
    assert [spec.local for spec, _ in station.bridge.flows if spec.rule.kind == "node"] == ["/n*"]
