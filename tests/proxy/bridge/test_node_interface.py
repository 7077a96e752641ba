"""What every node has: it crosses by its full name, and by no pattern that ends with a star."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.ros_names import Kind
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites, named
from tests.proxy.rule_files import furnish, proxy, rules

TOPICS = ["/rosout", "/rosout_agg", "/parameter_events"]
SERVICES = [
    f"/arm/base/{each}"
    for each in (
        "describe_parameters", "get_parameter_types", "get_parameters", "list_parameters", "set_parameters",
        "set_parameters_atomically", "get_type_description", "get_loggers", "set_logger_level",
    )
]  # fmt: skip


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_that_every_node_has_crosses_by_its_full_name(sites: Sites, name: str) -> None:
    robot = sites.add(ROBOT, expose=[f"kind: service, name: {name}"], holds=[named(name, SET_BOOL, "service")])
    station = sites.add(SERVER, imports=[f"kind: service, name: {name}, type: {SET_BOOL}"])
    LocalServer(robot.graph, name, answer=lambda raw: switched(f"got {raw[-1]}"))
    caller = Client(station.graph, name)
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("got 1")])


@pytest.mark.parametrize("name", [*TOPICS, "/fold/_action/status", "/_hidden"])
def test_a_topic_that_patterns_leave_out_crosses_by_its_full_name(sites: Sites, name: str) -> None:
    robot = sites.add(ROBOT, expose=[f"name: {name}, type: {STRING}"])
    station = sites.add(SERVER, imports=[f"name: {name}, type: {STRING}"])
    ear, talker = Ear(station.graph, name), robot.graph.publish("/talker", name, STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])


@pytest.mark.parametrize("pattern", ["/**", "/arm/**", "/arm/base/*", "/arm/*/*"])
def test_a_pattern_that_ends_with_a_star_leaves_them_to_the_machine(sites: Sites, pattern: str) -> None:
    robot = sites.add(ROBOT, expose=[f"kind: service, name: {pattern}", "name: /**"], holds=[])
    for name in SERVICES:
        LocalServer(robot.graph, name, answer=lambda raw: raw)
    for name in TOPICS:
        robot.graph.publish("/talker", name, STRING)
    sites.run(2)
    assert (robot.carried, robot.faults) == (set(), {})


def test_a_pattern_that_spells_them_out_takes_them(sites: Sites) -> None:
    name = "/base/get_parameters"
    robot = sites.add(
        ROBOT, expose=["kind: service, name: /base/*_parameters"], holds=[named(name, SET_BOOL, "service")]
    )
    LocalServer(robot.graph, name, answer=lambda raw: raw)
    sites.run(2)
    assert robot.carried == {(name, True)}


def test_a_pattern_imports_what_its_owner_delegated(sites: Sites) -> None:
    name = "/base/get_parameters"
    robot = sites.add(ROBOT, expose=[f"kind: service, name: {name}, type: {SET_BOOL}"])
    station = sites.add(SERVER, imports=["kind: service, name: /**"], holds=[named(name, SET_BOOL, "service")])
    LocalServer(robot.graph, name, answer=lambda raw: switched("yes"))
    caller = Client(station.graph, name)
    assert sites.run(3, caller.sees_server)


@pytest.mark.parametrize(
    ("kind", "pattern", "name", "is_meant"),
    [
        ("topic", "/*", "/rosout", False),
        ("topic", "/ros*", "/rosout", True),
        ("topic", "/a/*", "/a/rosout", True),  # a topic of its author's
        ("topic", "/a/*", "/a/get_parameters", True),
        ("service", "/a/*", "/a/get_parameters", False),
        ("service", "/**/get_parameters", "/a/get_parameters", True),
        ("service", "/a/*", "/a/change_state", True),  # only lifecycle nodes have it
        ("action", "/a/*", "/a/get_parameters", True),
    ],
)
def test_who_is_meant_by_a_pattern(tmp_path: Path, kind: Kind, pattern: str, name: str, is_meant: bool) -> None:
    furnish(tmp_path)
    (rule,) = proxy(
        tmp_path, f"ros: {{endpoint: ros2, domain: 0}}\nexpose:\n{rules(f'kind: {kind}, name: {pattern}')}"
    ).expose
    assert rule.means(name) is is_meant
    assert rule.leaves_out(name) is not is_meant
    assert rule.of_recording({}).means(name)  # a recording is carried as it is
