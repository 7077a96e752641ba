"""Real ROS 2 nodes, in a graph of their own on this machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from fog.cluster import CloudNode
from fog.launch.interface_discovery import cache_file, kept, offered
from fog.launch.interface_discovery_worker import offers
from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import GraphEntity, Role

ECHO = (CloudNode("fog_demo", "echo"),)


def test_what_a_node_offers_is_found_out_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2's rclpy")
    cache = tmp_path / "deep" / "offered.json"
    assert kept(ECHO, cache=cache) is None
    assert offered(ECHO, cache=cache) == (("service", "/echo", "std_srvs/srv/SetBool"),)
    assert kept(ECHO, cache=cache) == (("service", "/echo", "std_srvs/srv/SetBool"),)
    assert kept((*ECHO, *ECHO), cache=cache) is None
    offered(ECHO, cache=cache)
    assert capsys.readouterr().err.count("starting the nodes once, to see what they offer") == 1


def test_a_node_that_ends_is_reported_with_its_last_output(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2's rclpy")
    with pytest.raises(LocalError, match=r"a node ended: .*can't open 'absent'"):
        offered([CloudNode("json", "tool", ("absent",))], cache=tmp_path / "offered.json")


def test_a_torn_cache_is_an_empty_one(tmp_path: Path) -> None:
    cache = tmp_path / "offered.json"
    cache.write_text('{"a": [', encoding="utf-8")
    assert kept(ECHO, cache=cache) is None


def test_findings_are_kept_in_the_users_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/x")
    assert cache_file() == Path("/x/gdp/offered.json")


def test_an_action_is_one_thing_and_what_is_called_is_none() -> None:
    def served(name: str, type_name: str, role: Role = Role.SERVES) -> GraphEntity:
        return GraphEntity(role, name, type_name, "/n", name)

    graph = frozenset(
        {
            served("/fold/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal"),
            served("/fold/_action/cancel_goal", "action_msgs/srv/CancelGoal"),
            served("/fold/_action/get_result", "test_msgs/action/Fibonacci_GetResult"),
            served("/plan", "nav_msgs/srv/GetPlan"),
            served("/asked", "std_srvs/srv/Trigger", Role.CALLS),
        }
    )
    assert offers(graph) == [
        ("action", "/fold", "test_msgs/action/Fibonacci"),
        ("service", "/plan", "nav_msgs/srv/GetPlan"),
    ]
