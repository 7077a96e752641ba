"""Real nodes of ROS 2 and ROS 1 take, give and look at the control of a robot's topic by services."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lab.process import until
from netns_tests.live_pair import PATIENCE_S, Crossing, Pair, pair_of
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs", "std_srvs")
pytestmark = [pytest.mark.netns, pytest.mark.momentary("about requests, no lease matters")]

# desks: graph "a" (rclpy) and graph "one" (rospy); the robot: graph "b"
DRIVE = Crossing("/speed", "std_msgs/msg/Float64", "a one", "b", options={"control": "exclusive"})
_ROS2_DESK = """
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from concurrent.futures import ThreadPoolExecutor
pool = ThreadPoolExecutor(1)
stick = node.create_publisher(Float64, '/speed', 10)
kept.append(node.create_timer(0.05, lambda: stick.publish(Float64(data=1.0))))
clients = {act: node.create_client(Trigger, f'/speed/control/{act}') for act in ('take', 'give', 'show')}
def ask(act):
    if not clients[act].wait_for_service(20):
        return 'no service'
    answer = clients[act].call(Trigger.Request(), timeout_sec=10)
    return [answer.success, answer.message]
"""
_ROS1_DESK = """
import std_msgs.msg, std_srvs.srv
stick = talk(std_msgs.msg.Float64, '/speed')
timer = rospy.Timer(rospy.Duration(0.05), lambda _: stick.publish(2.0))
def ask(act):
    return call(std_srvs.srv.Trigger, f'/speed/control/{act}')
"""
_ROBOT = """
from std_msgs.msg import Float64
driven = []
kept.append(node.create_subscription(Float64, '/speed', lambda message: driven.append(message.data), 10))
"""


@pytest.fixture
def pair() -> Iterator[Pair]:
    with pair_of(DRIVE) as made:
        yield made


def gets(desk: Peer, act: str, text: str, *, is_done: bool) -> None:
    """Wait until a service of control answers so: its reader may not be known at once."""
    expected = [is_done, text]
    until(lambda: desk.tell(f"ask('{act}')") == expected, lambda: desk.tell(f"ask('{act}')"), PATIENCE_S)


def test_rclpy_and_rospy_hand_over_a_robot(pair: Pair) -> None:
    robot, one, two = pair.node("b", "base"), pair.node("a", "desk"), pair.node("one", "desk_of_ros1")
    robot.tell("!" + _ROBOT)
    one.tell("!" + _ROS2_DESK)
    two.tell("!" + _ROS1_DESK)
    gets(one, "show", "proxy-b: free", is_done=False)
    gets(two, "show", "proxy-b: free", is_done=False)
    assert robot.tell("driven") == []
    assert one.tell("ask('take')") == [True, "proxy-b: held by proxy-a"]
    robot.waits_for("driven[-1:]", [1.0])
    refused = two.tell("ask('take')")
    assert isinstance(refused, list)
    assert (refused[0], "another publisher holds control" in refused[1]) == (False, True)
    assert one.tell("ask('give')") == [True, "proxy-b: free"]
    robot.waits_for("driven[-1:]", [0.0])
    assert two.tell("ask('take')") == [True, "proxy-b: held by proxy-one"]
    robot.waits_for("driven[-1:]", [2.0])
    assert one.tell("ask('show')") == [False, "proxy-b: held by proxy-one"]
    driven = robot.tell("driven")
    assert isinstance(driven, list)
    assert [each for each, before in zip(driven, [None, *driven], strict=False) if each != before] == [1.0, 0.0, 2.0]
