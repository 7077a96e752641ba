"""Windows around calls: a call of an exposed service, a goal and its result mark topics, and the mark says which."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gdp.names import Name
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites
from tests.proxy.bridge.test_actions import ACCEPTED, RULE, ActionClient, ActionServer, goal, goal_id, result
from tests.proxy.bridge.test_from_store import keeper_of


def marks_of(sites: Sites, machine: Machine, folder: Path, when: Sequence[str]) -> list[str]:
    """Keep a topic of a machine around events; return the names of the marks that come."""
    marks, topic, keeper = list[str](), Name(b"t" * 32), keeper_of(sites, machine, folder)
    kept: Any = SimpleNamespace(mark=lambda name, _time_ns: marks.append(name), name=topic)
    keeper._when = {each: {topic} for each in when}
    capsules: Any = SimpleNamespace(topics={topic: kept}, capsules=[], handle=lambda _: None, get_timer=lambda: None)
    keeper.capsules = capsules
    return marks


def test_a_call_of_a_service_marks_who_called(tmp_path: Path) -> None:
    sites, services = Sites(tmp_path), [f"kind: service, name: {name}, type: {SET_BOOL}" for name in ("/a", "/b")]
    server, client = sites.add(SERVER, expose=services), sites.add(ROBOT, imports=services)
    marks = marks_of(sites, server, tmp_path, ["/a"])
    for name in ("/a", "/b"):
        LocalServer(server.graph, name, answer=lambda _: switched("yes"))
    callers = [Client(client.graph, name) for name in ("/a", "/b")]
    assert sites.run(3, lambda: all(each.sees_server() for each in callers))
    assert marks == []
    for each in callers:
        each.call(switch(on=True))
    assert sites.run(1, lambda: all(each.outcomes for each in callers))
    assert marks == [f"/a {client.member.name.short}"]


def test_a_goal_and_its_result_mark_their_id(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    server, client = sites.add(SERVER, expose=[RULE]), sites.add(ROBOT, imports=[RULE])
    marks = marks_of(sites, server, tmp_path, ["/count/goal", "/count/result"])
    local, caller = ActionServer(server.graph), ActionClient(client.graph)
    assert sites.run(3, caller.sees_server)
    for number in (1, 2):
        caller.goals.call(goal(number, 10))
        caller.results.call(goal_id(number))
    assert sites.run(1, lambda: caller.goals.outcomes == [ACCEPTED, ACCEPTED])
    sites.run(2)
    goals = [f"/count/goal {bytes([number] * 16).hex()}" for number in (1, 2)]
    assert marks == goals
    local.results.waiting[1][1](result(1))
    assert sites.run(1, lambda: caller.results.outcomes == [result(1)])
    assert marks == [*goals, f"/count/result {local.results.waiting[1][0][4:20].hex()}"]
