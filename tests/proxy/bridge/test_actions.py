"""Actions from end to end: goals of any length, feedback to all clients, cancel, result."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from proxy.endpoints.core.qos import default
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import FIBONACCI
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph, Publication

RULE = f"kind: action, name: /count, type: {FIBONACCI}, timeout_s: 2"
CDR = b"\0\1\0\0"
AT = "/count/_action/"
FEEDBACK, STATUS = f"{FIBONACCI}_FeedbackMessage", "action_msgs/msg/GoalStatusArray"
ACCEPTED, CANCELED = CDR + b"\1", CDR + b"\0"
UNACCEPTED = CDR + b"\0"  # an empty response


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def goal(number: int, order: int) -> bytes:
    return CDR + bytes([number]) * 16 + struct.pack("<i", order)


def goal_id(number: int) -> bytes:
    return CDR + bytes([number]) * 16


def sequence(number: int, *values: int) -> bytes:
    return goal_id(number) + struct.pack(f"<I{len(values)}i", len(values), *values)


def result(*values: int) -> bytes:
    return CDR + b"\4\0\0\0" + struct.pack(f"<I{len(values)}i", len(values), *values)


@dataclass(slots=True)
class ActionServer:
    """Node that serves an action; it accepts goals at once, and sends results on command of a test."""

    graph: FakeGraph
    goals: LocalServer = field(init=False)
    cancels: LocalServer = field(init=False)
    results: LocalServer = field(init=False)
    feedback: Publication = field(init=False)

    def __post_init__(self) -> None:
        graph = self.graph
        self.goals = LocalServer(graph, f"{AT}send_goal", f"{FIBONACCI}_SendGoal", lambda _: ACCEPTED)
        self.cancels = LocalServer(graph, f"{AT}cancel_goal", "action_msgs/srv/CancelGoal", lambda _: CANCELED)
        self.results = LocalServer(graph, f"{AT}get_result", f"{FIBONACCI}_GetResult")
        self.feedback = graph.publish("/server", f"{AT}feedback", FEEDBACK)
        graph.publish("/server", f"{AT}status", STATUS, default(latched=True, depth=1))

    def leave(self) -> None:
        for server in (self.goals, self.cancels, self.results):
            server.handle.close()
        for publication in [each for each in self.graph.publications if each.end.node == "/server"]:
            publication.close()


class ActionClient:
    """Node that sends goals."""

    def __init__(self, graph: FakeGraph) -> None:
        self.goals, self.cancels, self.results = (
            Client(graph, f"{AT}{part}") for part in ("send_goal", "cancel_goal", "get_result")
        )
        self.feedback = Ear(graph, f"{AT}feedback", FEEDBACK, node="/client")

    def sees_server(self) -> bool:
        return all(client.sees_server() for client in (self.goals, self.cancels, self.results))


def pair(sites: Sites, rule: str = RULE) -> tuple[Machine, ActionServer, ActionClient]:
    """Return the client's machine, an action server and a far client that sees it."""
    server, client = sites.add(SERVER, expose=[rule]), sites.add(ROBOT, imports=[rule])
    local, caller = ActionServer(server.graph), ActionClient(client.graph)
    assert sites.run(3, caller.sees_server)
    return client, local, caller


@pytest.mark.parametrize("sign", ["always", "session"])
def test_a_goal_that_takes_longer_than_every_timeout_ends_with_its_result(sites: Sites, sign: str) -> None:
    client, local, caller = pair(sites, f"{RULE}, sign: {sign}")
    caller.goals.call(goal(1, 10))
    assert sites.run(1, lambda: caller.goals.outcomes == [ACCEPTED])
    caller.results.call(goal_id(1))
    sites.run(60)
    assert (caller.results.outcomes, client.faults) == ([], {})
    local.results.waiting[0][1](result(1, 1, 2, 3))
    assert sites.run(1, lambda: caller.results.outcomes == [result(1, 1, 2, 3)])


def test_a_goal_that_the_server_does_not_answer_fails_in_time(sites: Sites) -> None:
    client, local, caller = pair(sites)
    local.goals.answer = None
    caller.goals.call(goal(1, 10))
    assert sites.run(2.2, lambda: bool(caller.goals.outcomes)), "nothing"
    assert caller.goals.outcomes == [UNACCEPTED]
    assert client.faults == {"timed-out": 1}


def test_feedback_reaches_every_client_on_every_machine_once(sites: Sites) -> None:
    client, local, caller = pair(sites)
    third = sites.add("nuc3/third", imports=[RULE])
    others = [ActionClient(client.graph), ActionClient(third.graph)]
    assert sites.run(3, others[1].sees_server)
    caller.goals.call(goal(1, 10))
    assert sites.run(1, lambda: caller.goals.outcomes == [ACCEPTED])
    reported = [sequence(1, *range(count)) for count in range(20)]
    sites.every(0.1, 20, lambda number: local.feedback.publish(reported[number]))
    sites.run(4)
    assert [each.feedback.heard for each in (caller, *others)] == [reported] * 3


@pytest.mark.parametrize(
    ("who", "to"),
    [(ROBOT, "nuc3"), (SERVER, "nuc3"), pytest.param(SERVER, "nuc1", marks=pytest.mark.nightly)],
    ids=["to another domain", "within a domain", "back to the client"],
)
def test_a_goal_goes_on_while_a_machine_moves_to_another_switch(sites: Sites, who: str, to: str) -> None:
    client, local, caller = pair(sites)
    caller.goals.call(goal(1, 10))
    assert sites.run(1, lambda: caller.goals.outcomes == [ACCEPTED])
    caller.results.call(goal_id(1))
    reported = [sequence(1, *range(count)) for count in range(40)]
    sites.every(0.1, len(reported), lambda number: local.feedback.publish(reported[number]))
    sites.world.network.call(1.55, lambda: sites.world.roam(who, to))
    sites.run(8)
    assert caller.feedback.heard == reported
    local.results.waiting[0][1](result(1, 1, 2, 3))
    assert sites.run(1, lambda: bool(caller.results.outcomes))
    sites.run(5)
    assert (caller.results.outcomes, len(local.results.waiting), client.faults) == ([result(1, 1, 2, 3)], 1, {})


def test_a_goal_is_cancelled(sites: Sites) -> None:
    _, local, caller = pair(sites)
    caller.goals.call(goal(1, 10))
    caller.results.call(goal_id(1))
    sites.run(5)
    caller.cancels.call(goal_id(1))
    assert sites.run(1, lambda: caller.cancels.outcomes == [CANCELED])
    local.results.waiting[0][1](result())
    assert sites.run(1, lambda: caller.results.outcomes == [result()])


def test_goals_of_several_clients_end_with_their_own_results(sites: Sites) -> None:
    _, local, caller = pair(sites)
    third = sites.add("nuc3/third", imports=[RULE])
    other = ActionClient(third.graph)
    assert sites.run(3, other.sees_server)
    for number, each in enumerate((caller, other)):
        each.goals.call(goal(number, 10))
        each.results.call(goal_id(number))
    assert sites.run(2, lambda: len(local.results.waiting) == 2)
    for raw, done in reversed(local.results.waiting):
        done(result(raw[-1]))
    assert sites.run(1, lambda: bool(caller.results.outcomes and other.results.outcomes))
    assert (caller.results.outcomes, other.results.outcomes) == ([result(0)], [result(1)])


def test_a_server_that_leaves_fails_the_waiting_results_with_a_reason(sites: Sites) -> None:
    _, local, caller = pair(sites)
    caller.results.call(goal_id(1))
    sites.run(10)
    local.leave()
    assert sites.run(1, lambda: len(caller.results.outcomes) == 1)
    assert isinstance(caller.results.outcomes[0], str)
    assert sites.run(1.5, lambda: not caller.sees_server())


def test_the_parts_of_an_action_do_not_cross_by_a_pattern_of_topics(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=["name: /**", "kind: service, name: /**"], holds=[])
    ActionServer(robot.graph)
    sites.run(2)
    assert (robot.carried, robot.faults) == (set(), {})
