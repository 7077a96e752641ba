"""Proxy and node of ROS 2 Kilted on one machine, of Jazzy on the other: both from wheels."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from lab.process import until
from netns_tests.live_pair import PATIENCE_S, Crossing, Pair, pair_of
from tests.pages import ROOT
from tests.proxy.endpoints.ros2_net import needs

needs("sensor_msgs", "std_srvs")
pytestmark = [pytest.mark.netns, pytest.mark.nightly]

WHEELS: Final = [f"ros-kilted-{each}" for each in ("rclpy", "rmw-fastrtps-cpp", "sensor-msgs", "std-msgs", "std-srvs")]
RANGE, SET_BOOL = "sensor_msgs/msg/Range", "std_srvs/srv/SetBool"
BEGIN: Final = """
from importlib.metadata import version
from sensor_msgs.msg import Range
from std_srvs.srv import SetBool
def say(topic, near):
    message = Range(min_range=near)
    message.header.frame_id = 'sonar'
    out = node.create_publisher(Range, topic, 10)
    kept.append(node.create_timer(0.1, lambda: out.publish(message)))
def read(topic):
    heard[topic] = []
    kept.append(node.create_subscription(Range, topic, lambda m: heard[topic].append(values(m)), 10))
def serve(name):
    def answer(request, response):
        response.success, response.message = request.data, name
        return response
    kept.append(node.create_service(SetBool, name, answer))
def ask(name):
    client = node.create_client(SetBool, name)
    found = []
    if client.wait_for_service(20):
        kept.append(client)
        client.call_async(SetBool.Request(data=True)).add_done_callback(lambda f: found.append(values(f.result())))
    return found
"""


@pytest.fixture(scope="module")
def kilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kilted")
    python = folder / "bin/python"
    subprocess.run([sys.executable, "-m", "venv", folder], check=True, timeout=300)
    locked = ["--no-deps", "--require-hashes", "-r", str(ROOT / "requirements/run.lock")]
    for words in (WHEELS, locked):
        done = subprocess.run(
            [python, "-m", "pip", "install", "-q", *words], check=False, capture_output=True, text=True, timeout=900
        )
        if done.returncode:
            pytest.skip(f"pip cannot install the wheels of Kilted: {done.stderr.strip().splitlines()[-1]}")
    return python


@pytest.fixture(scope="module")
def pair(kilted: Path) -> Iterator[Pair]:
    crossings = (
        Crossing("/there", RANGE, "a", "b"),
        Crossing("/back", RANGE, "b", "a"),
        Crossing("/arm", SET_BOOL, "a", "b", "service"),
        Crossing("/gate", SET_BOOL, "b", "a", "service"),
    )
    with pair_of(*crossings, pythons={"a": kilted}) as made:
        yield made


def test_kilted_and_jazzy_have_each_others_topics_and_services(pair: Pair) -> None:
    nodes = {"a": pair.node("a"), "b": pair.node("b")}
    for each, said, heard, served in (("a", "/there", "/back", "/arm"), ("b", "/back", "/there", "/gate")):
        nodes[each].tell("!" + BEGIN)
        nodes[each].tell(f"!say({said!r}, {0.5 if each == 'a' else 0.25})\nread({heard!r})\nserve({served!r})")
    assert nodes["a"].tell("version('ros-rclpy')") != nodes["b"].tell("version('ros-rclpy')")
    for each, heard, near, called in (("a", "/back", 0.25, "/gate"), ("b", "/there", 0.5, "/arm")):
        until(lambda: nodes[each].tell(f"heard[{heard!r}]"), f"messages of {heard}", PATIENCE_S)  # noqa: B023
        message = nodes[each].tell(f"heard[{heard!r}][0]")
        assert isinstance(message, list)
        assert message[0][1] == "sonar"
        assert near in message, message
        nodes[each].tell(f"!found = ask({called!r})")
        until(lambda: nodes[each].tell("found"), f"an answer of {called}", PATIENCE_S)  # noqa: B023
        assert nodes[each].tell("found") == [[True, called]]
    for each in "ab":
        assert not pair.proxy(each).warnings("/there") + pair.proxy(each).warnings("/back")
