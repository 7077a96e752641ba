"""A node crosses whole: it appears elsewhere under its name with what it has, and disappears when it ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.metadata import Metadata
from gdp.ros_names import NODE_TYPE
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


def pair(sites: Sites, holds: list[Metadata] = HOLDS) -> tuple[Machine, Machine]:
    robot = sites.add(ROBOT, expose=["kind: node, name: /talker"], holds=holds)
    station = sites.add(SERVER, imports=["kind: node, name: /talker"], holds=holds)
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


def test_its_messages_and_calls_cross_in_both_directions(sites: Sites) -> None:
    robot, station = pair(sites)
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
