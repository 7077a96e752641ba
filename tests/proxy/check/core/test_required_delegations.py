"""Delegations that rules need: on two machines, from statements, stored ones and the live graph."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.metadata import Metadata
from gdp.trust.right import Right
from proxy.check.core.required_delegations import Machine, RequiredDelegation, needs, unmet
from proxy.config.config import ProxyConfig
from proxy.endpoints.core.endpoint import GraphEntity, Role
from tests.proxy.rule_files import OTHER, OWNER, furnish, proxy, rules

ROS = "ros: {endpoint: ros2, domain: 0}\n"
IMAGE = "sensor_msgs/msg/Image"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Path:
    furnish(tmp_path)
    return tmp_path


def _config(folder: Path, expose: str = "", imports: str = "") -> ProxyConfig:
    text = ROS + (f"expose:\n{rules(expose)}" if expose else "") + (f"import:\n{rules(imports)}" if imports else "")
    return proxy(folder, text)


def _said(found: list[RequiredDelegation]) -> list[tuple[str, str, str]]:
    rights = [" ".join(sorted(right.value for right in need.rights)) for need in found]
    names = [(str(need.metadata["name"]), str(need.metadata["type"])) for need in found]
    return [(right, *name) for right, name in zip(rights, names, strict=True)]


def _of(*machines: Machine) -> list[list[tuple[str, str, str]]]:
    return [_said(each) for each in needs(machines, OWNER.public)]


def test_what_a_rule_states_is_needed(folder: Path) -> None:
    expose = _config(folder, "name: /lamp, kind: service, type: std_srvs/srv/SetBool")
    imports = _config(folder, imports="name: /lamp, kind: service, type: std_srvs/srv/SetBool")
    lamp = ("/lamp", "std_srvs/srv/SetBool")
    assert _of(Machine(expose), Machine(imports)) == [[("serve", *lamp)], [("call", *lamp)]]


def test_what_is_live_gives_a_pattern_its_names_on_both_sides(folder: Path) -> None:
    names = (("/camera/left", IMAGE), ("/odom", "nav_msgs/msg/Odometry"))
    live = frozenset(GraphEntity(Role.PUBLISHES, *name, node="/base", key=name[0]) for name in names)
    robot = Machine(_config(folder, "name: /camera/**"), graphs=[live])
    server = Machine(_config(folder, imports="name: /camera/**"))
    assert _of(robot, server) == [[("publish", "/camera/left", IMAGE)], [("read", "/camera/left", IMAGE)]]


def test_an_action_gets_its_type_from_what_is_live(folder: Path) -> None:
    goal = GraphEntity(Role.SERVES, "/fold/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal", "/arm", "1")
    arm = Machine(_config(folder, "name: /fold, kind: action"), graphs=[frozenset({goal})])
    desk = Machine(_config(folder, imports="name: /fold, kind: action"))
    fold = ("/fold", "test_msgs/action/Fibonacci")
    assert _of(arm, desk) == [[("serve", *fold)], [("call", *fold)]]


def test_a_node_needs_what_it_has_on_both_sides(folder: Path) -> None:
    has = ((Role.PUBLISHES, "/scan"), (Role.SUBSCRIBES, "/goal"), (Role.SUBSCRIBES, "/stop"))
    live = frozenset(GraphEntity(role, name, IMAGE, "/base", name) for role, name in has)
    robot = Machine(_config(folder, "name: /base, kind: node"), graphs=[live])
    desk = Machine(_config(folder, "name: /goal", "name: /base, kind: node"))
    base = ("/base", "gdp/Node")
    heard = [("read", "/goal", IMAGE), ("publish", "/scan", IMAGE), ("read", "/stop", IMAGE)]
    assert _of(robot, desk) == [
        [("serve", *base), *heard],
        [("call", *base), ("publish", "/goal", IMAGE), ("read", "/scan", IMAGE)],
    ]


def test_no_machine_may_publish_a_topic_that_only_another_machine_has(folder: Path) -> None:
    one = Machine(_config(folder, f"name: /camera/left, type: {IMAGE}"))
    other = Machine(_config(folder, "name: /camera/**"))
    assert _of(one, other) == [[("publish", "/camera/left", IMAGE)], []]


def test_a_topic_both_exposed_and_imported_needs_both_rights_at_once(folder: Path) -> None:
    both = f"name: /map, type: {IMAGE}"
    assert _of(Machine(_config(folder, both, both))) == [[("publish read", "/map", IMAGE)]]


def test_rules_of_another_owner_are_not_this_owners_to_meet(folder: Path) -> None:
    config = _config(folder, f"name: /map, type: {IMAGE}, owner: other.pub")
    assert needs([Machine(config)], OWNER.public) == [[]]
    assert unmet(config.expose, OWNER.public, []) == []
    assert unmet(config.expose, OTHER.public, []) == [config.expose[0]]


def test_a_pattern_that_nothing_is_known_of_is_unmet(folder: Path) -> None:
    config = _config(folder, "name: /camera/**")
    metadata = Metadata({"kind": "topic", "name": "/camera/left", "type": IMAGE})
    known = RequiredDelegation(metadata.name(OWNER.public.compressed), metadata, frozenset({Right.PUBLISH}))
    assert unmet(config.expose, OWNER.public, []) == [config.expose[0]]
    assert unmet(config.expose, OWNER.public, [known]) == []
