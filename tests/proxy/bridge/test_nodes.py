"""A node crosses whole: it appears elsewhere under its name with what it has, and disappears when it ends."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gdp.metadata import Metadata
from gdp.ros_names import NODE_TYPE
from proxy.bridge.name_facts import proxy_facts
from proxy.endpoints.core.endpoint import Role
from tests.proxy.bridge.clients import Client
from tests.proxy.bridge.known import FIBONACCI, SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites, named
from tests.proxy.endpoints.fake import FakeGraph

GET = "/talker/get_parameters"
HOLDS = [
    named("/talker", NODE_TYPE, "node"),
    named("/chatter"),
    named("/cmd"),
    named("/rosout"),
    named(GET, SET_BOOL, "service"),
    named("/fold", FIBONACCI, "action"),
]


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def talker(graph: FakeGraph, node: str = "/talker") -> list[object]:
    """Add a node with a publisher, a subscription, a service and an action."""
    parts = ("send_goal", "_SendGoal"), ("get_result", "_GetResult")
    return [
        graph.publish(node, "/chatter", STRING),
        graph.publish(node, "/rosout", STRING),
        graph.subscribe(node, "/cmd", STRING, lambda _: None),
        graph.serve(node, GET, SET_BOOL, lambda raw, done: done(switched(f"got {raw[-1]}"))),
        *(
            graph.serve(node, f"/fold/_action/{part}", f"{FIBONACCI}{end}", lambda _raw, _done: None)
            for part, end in parts
        ),
    ]


def shown(machine: Machine, node: str = "/talker") -> set[tuple[Role, str]]:
    """Return what a node has in a machine's graph."""
    return {(end.role, end.name) for end in machine.graph.ends() if end.node == node}


def pair(sites: Sites, holds: list[Metadata] = HOLDS, expose: Sequence[str] = ()) -> tuple[Machine, Machine]:
    robot = sites.add(ROBOT, expose=["kind: node, name: /talker"], holds=holds)
    station = sites.add(SERVER, imports=["kind: node, name: /talker"], expose=expose, holds=holds)
    return robot, station


def test_a_node_appears_with_what_it_has(sites: Sites) -> None:
    robot, station = pair(sites)
    talker(robot.graph)
    assert sites.run(5, lambda: (Role.SERVES, "/fold/_action/send_goal") in shown(station))
    assert shown(station) >= {
        (Role.PUBLISHES, "/chatter"),
        (Role.PUBLISHES, "/rosout"),
        (Role.SUBSCRIBES, "/cmd"),
        (Role.SERVES, GET),
    }
    assert not [*robot.faults, *station.faults]


def test_nothing_leaves_a_machine_because_a_far_node_subscribes_to_it(sites: Sites) -> None:
    robot, station = pair(sites)
    talker(robot.graph)
    station.graph.publish("/teleop", "/cmd", STRING)
    assert sites.run(5, lambda: (Role.SUBSCRIBES, "/cmd") in shown(station))
    sites.run(2)
    assert not any(is_exposed for _, is_exposed in station.carried)


def test_its_messages_and_calls_cross_in_both_directions(sites: Sites) -> None:
    robot, station = pair(sites, expose=["name: /cmd"])
    publication, *_ = talker(robot.graph)
    ear, order = Ear(station.graph, "/chatter"), Ear(robot.graph, "/cmd", node="/base")
    teleop = station.graph.publish("/teleop", "/cmd", STRING)
    caller = Client(station.graph, GET)
    assert sites.run(5, caller.sees_server)
    assert sites.run(5, lambda: ("/cmd", True) in station.carried)
    sites.run(2)
    publication.publish(string("hello"))  # type: ignore[attr-defined]
    teleop.publish(string("go"))
    caller.call(switch(on=True))
    assert sites.run(2, lambda: bool(ear.texts and order.texts and caller.outcomes))
    assert (ear.texts, order.texts, caller.outcomes) == (["hello"], ["go"], [switched("got 1")])


def test_it_disappears_when_it_ends(sites: Sites) -> None:
    robot, station = pair(sites)
    parts = talker(robot.graph)
    assert sites.run(5, lambda: bool(shown(station)))
    for each in parts:
        each.close()  # type: ignore[attr-defined]
    assert sites.run(1, lambda: not shown(station))
    assert sites.run(2, lambda: station.carried == {("/talker", False)})


def test_it_disappears_when_its_machine_is_silent(sites: Sites) -> None:
    robot, station = pair(sites)
    talker(robot.graph)
    assert sites.run(5, lambda: bool(shown(station)))
    sites.world.network.freeze(robot.label)
    assert sites.run(3, lambda: not shown(station))
    sites.world.network.thaw(robot.label)
    assert sites.run(20, lambda: bool(shown(station)))


@pytest.mark.parametrize("is_robot", [True, False])
def test_it_disappears_when_it_loses_its_grant(sites: Sites, *, is_robot: bool) -> None:
    robot, station = pair(sites)
    talker(robot.graph)
    assert sites.run(5, lambda: bool(shown(station)))
    rules = ["kind: node, name: /talker"]
    if is_robot:
        sites.reload(robot, expose=rules, holds=HOLDS[1:])
    else:
        sites.reload(station, imports=rules, holds=HOLDS[1:])
    assert sites.run(3, lambda: not shown(station))
    assert sites.run(3, lambda: station.carried <= {("/talker", False)})


def test_what_it_gains_and_loses_follows(sites: Sites) -> None:
    robot, station = pair(sites)
    chatter, *_ = talker(robot.graph)
    assert sites.run(5, lambda: (Role.PUBLISHES, "/chatter") in shown(station))
    chatter.close()  # type: ignore[attr-defined]
    assert sites.run(1, lambda: (Role.PUBLISHES, "/chatter") not in shown(station))
    robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(1, lambda: (Role.PUBLISHES, "/chatter") in shown(station))


def test_a_topic_of_two_nodes_stays_while_one_has_it(sites: Sites) -> None:
    holds = [*HOLDS, named("/*", NODE_TYPE, "node")]
    robot = sites.add(ROBOT, expose=["kind: node, name: /*"], holds=holds)
    station = sites.add(SERVER, imports=["kind: node, name: /*"], holds=holds)
    parts, second = talker(robot.graph), robot.graph.publish("/other", "/chatter", STRING)
    ear = Ear(station.graph, "/chatter")
    assert sites.run(
        5, lambda: all((Role.PUBLISHES, "/chatter") in shown(station, each) for each in ("/talker", "/other"))
    )
    for each in parts:
        each.close()  # type: ignore[attr-defined]
    assert sites.run(2, lambda: not shown(station))
    second.publish(string("still here"))
    assert sites.run(2, lambda: ear.texts == ["still here"])


def test_another_proxy_of_the_graph_does_not_send_a_far_node_out_again(sites: Sites) -> None:
    robot, station = pair(sites)
    second = sites.add(
        "nuc3/second",
        graph=station.graph,
        expose=["kind: node, name: /**", "name: /**", "kind: service, name: /**"],
        holds=HOLDS,
    )
    talker(robot.graph)
    assert sites.run(5, lambda: (Role.SERVES, GET) in shown(station))
    sites.run(2)
    assert second.carried == set()


def test_a_prefix_holds_for_all_that_it_has(sites: Sites) -> None:
    holds = [named(f"/arm{each['name']}", str(each["type"]), str(each["kind"])) for each in HOLDS]
    robot = sites.add(ROBOT, expose=["kind: node, name: /talker, prefix: arm"], holds=holds)
    station = sites.add(SERVER, imports=["kind: node, name: /arm/talker"], holds=holds)
    plain = sites.add("nuc5/plain", imports=["kind: node, name: /talker, prefix: arm"], holds=holds)
    talker(robot.graph)
    assert sites.run(5, lambda: (Role.SERVES, "/arm" + GET) in shown(station, "/arm/talker"))
    assert sites.run(5, lambda: (Role.SERVES, GET) in shown(plain))


def test_a_rule_about_a_name_itself_precedes_that_of_its_node(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=["kind: node, name: /talker", "name: /chat*, max_hz: 1"], holds=HOLDS)
    talker(robot.graph)
    assert sites.run(5, lambda: ("/chatter", True) in robot.carried)
    rules = {spec.local: spec.rule for spec, _ in robot.bridge.flows}
    assert (rules["/chatter"].max_hz, rules["/rosout"].max_hz) == (1, None)


def test_what_is_known_of_a_node_of_a_pattern_is_that_of_its_rule(sites: Sites) -> None:
    holds = [*HOLDS, named("/*", NODE_TYPE, "node")]
    robot = sites.add(ROBOT, expose=["kind: node, name: /*"], holds=holds)
    station = sites.add(SERVER, imports=["kind: node, name: /*"], holds=holds)
    talker(robot.graph)
    assert sites.run(5, lambda: bool(shown(station)))
    identity = next(each for each in sites.world.identities.values() if each.name == robot.member.name)
    facts = proxy_facts(robot.bridge, robot.context, identity, "/talker", sites.world.network.now)
    (flow,) = [each for each in facts.flows if each.kind == "node"]
    assert (flow.is_carried, flow.nodes, flow.delegated) == (True, 1, "yes")
