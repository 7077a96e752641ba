"""Suggested rules: what of a graph they name, and that no text of another node can leave its comment."""

from __future__ import annotations

import yaml

from proxy.check.suggestion import Offered, Traffic, offered_names, suggested_file
from proxy.endpoints.core.endpoint import GraphEntity, Role

STRING = "std_msgs/msg/String"


def entity(role: Role, name: str, type_name: str, node: str = "/robot") -> GraphEntity:
    return GraphEntity(role, name, type_name, node, name)


def test_what_every_node_has_is_not_suggested() -> None:
    graph = frozenset(
        {
            entity(Role.PUBLISHES, "/chatter", STRING),
            entity(Role.PUBLISHES, "/rosout", "rcl_interfaces/msg/Log"),
            entity(Role.SUBSCRIBES, "/heard", STRING),
            entity(Role.SERVES, "/robot/get_parameters", "rcl_interfaces/srv/GetParameters"),
            entity(Role.SERVES, "/enable", "std_srvs/srv/SetBool"),
            entity(Role.SERVES, "/fold/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal"),
            entity(Role.PUBLISHES, "/fold/_action/feedback", "test_msgs/action/Fibonacci_FeedbackMessage"),
            entity(Role.PUBLISHES, "/copied", STRING, "/gdp_proxy_0123456789ab"),
        }
    )
    assert [(each.kind, each.name, each.type_name) for each in offered_names(graph)] == [
        ("action", "/fold", "test_msgs/action/Fibonacci"),
        ("service", "/enable", "std_srvs/srv/SetBool"),
        ("topic", "/chatter", STRING),
    ]


def test_a_rule_is_a_comment_with_rate_and_size() -> None:
    offered = [
        Offered(kind="topic", name="/chatter", type_name=STRING, nodes=("/robot",), traffic=Traffic(30, 30_720, 3.0))
    ]
    text = suggested_file(offered, "dds", "ros2 domain 0")
    assert "#   # 10 Hz, 1 KiB each; from /robot\n" in text
    assert yaml.safe_load(text).keys() == {"identity", "domain", "delegations", "iface", "ros"}


def test_text_of_another_node_cannot_leave_its_comment() -> None:
    evil = "/x\nexpose: [{name: /secret}]"
    text = suggested_file([Offered(kind="topic", name=evil, type_name=evil, nodes=(evil,))], "dds", "ros2 domain 0")
    assert "expose" not in yaml.safe_load(text)
