"""A robot with a namespace, between real ROS 2 graphs on two machines; its rules change by command while it runs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping

import pytest

from lab.machine import gdp as gdp_command
from lab.process import until
from netns_tests.live_pair import Crossing, Pair, pair_of
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs")
if shutil.which("nsenter") is None or shutil.which("setpriv") is None:
    pytest.skip("nsenter or setpriv is not installed (util-linux)", allow_module_level=True)

pytestmark = pytest.mark.netns

STRING = "std_msgs/msg/String"
PREFIX = "robot1"
_NODE = """
from std_msgs.msg import String
heard = {}
def read(topic):
    found = heard[topic] = []
    return node.create_subscription(String, topic, lambda m: found.append(m.data), 10)
"""


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with pair_of(Crossing("/chat", STRING, "a", "b", options={"prefix": PREFIX})) as made:
        yield made


def gdp(pair: Pair, label: str, *words: str) -> list[Mapping[str, object]]:
    """Return what a command about a running proxy prints as JSON, a line each."""
    printed = gdp_command(*words, "--config", pair.folder / f"proxy-{label}.yaml", "--json")
    return [json.loads(line) for line in printed.splitlines()]


def started(pair: Pair, graph: str) -> Peer:
    node = pair.node(graph)
    node.tell("!" + _NODE)
    return node


def test_a_prefixed_topic_crosses_is_watched_and_is_denied_by_command(pair: Pair) -> None:
    robot, station = started(pair, "a"), started(pair, "b")
    station.tell("!reading = read('/chat')")
    robot.tell("!chat = node.create_publisher(String, '/chat', 10)")

    def arrives() -> object:
        robot.tell("chat.publish(String(data='hello'))")
        return station.tell("len(heard['/chat'])")

    until(arrives, "/chat at the station")
    (event,) = gdp(pair, "b", "watch", f"/{PREFIX}/*", "--count", "1")
    assert (event["event"], event["role"], event["name"]) == ("appears", "publisher", f"/{PREFIX}/chat")
    assert gdp(pair, "a", "rule", "add", "deny", "/chat")[0]["applied"] == "now"
    until(lambda: not gdp(pair, "b", "watch", "/chat", "--for", "0"), "the publisher goes")
    assert gdp(pair, "a", "rule", "remove", "deny", "/chat")[0]["applied"] == "now"
    station.tell("!heard['/chat'].clear()")
    until(arrives, "/chat at the station again")
