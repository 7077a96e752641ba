"""Page on robots, run by its own commands on two machines, with real nodes as robot and server.

The keyboard input between two commands uses process numbers: a namespace shares its processes.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from lab.namespaces import Space, cable
from tests.machines import Machines
from tests.pages import ROOT, blocks_between
from tests.proxy.endpoints.ros1_net import need_ros1
from tests.proxy.endpoints.ros2_net import CONFINED, DOMAIN, Peer, needs, peer_of

needs("sensor_msgs", "nav_msgs", "geometry_msgs", "std_srvs", "test_msgs")
if shutil.which("nsenter") is None:
    pytest.skip("nsenter is not installed (util-linux)", allow_module_level=True)

pytestmark = pytest.mark.netns

PAGE = ROOT / "docs/tutorials/robots.md"
_ROS2 = ", with ros2"
_ROBOT = """
from rclpy.action import ActionServer
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, LaserScan
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci
camera, scan, odom = talk(Image, '/camera/left'), talk(LaserScan, '/scan', 'best_effort'), talk(Odometry, '/odom')
picture = Image(height=2, width=2, encoding='rgb8', step=6, data=bytes(range(12)))
sweep = LaserScan(ranges=[1.0, 2.0])
sweep.header.frame_id = 'laser'
listen(Twist, '/cmd_vel')
def tick():
    camera.publish(picture)
    scan.publish(sweep)
    odom.publish(Odometry(child_frame_id='base'))
def switch(request, response):
    response.success, response.message = True, f'the lamp is {request.data}'
    return response
def drive(goal):
    goal.publish_feedback(Fibonacci.Feedback(sequence=[1]))
    goal.succeed()
    return Fibonacci.Result(sequence=[1] * goal.request.order)
kept += [node.create_timer(0.05, tick), node.create_service(SetBool, '/lamp', switch)]
kept.append(ActionServer(node, Fibonacci, '/navigate', drive))
"""
_DESK = """
from rclpy.action import ActionClient
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image
from test_msgs.action import Fibonacci
listen(Image, '/camera/left')
steering, client = talk(Twist, '/cmd_vel'), ActionClient(node, Fibonacci, '/navigate')
kept.append(node.create_timer(0.1, lambda: steering.publish(Twist())))
results = []
def arrived(future):
    results.append(len(future.result().result.sequence))
def begun(future):
    future.result().get_result_async().add_done_callback(arrived)
"""


@pytest.fixture
def server(space: Space) -> Iterator[Space]:
    """Namespace of the server; the thread is on the robot."""
    with cable(space) as there:
        yield there


@pytest.fixture
def machines(server: Space, tmp_path: Path) -> Iterator[Machines]:
    """Two machines with a ROS 2 each, whose graphs do not leave them."""
    with Machines(tmp_path, server) as two:
        ros1 = {"ROS_HOSTNAME": "localhost", "ROS_MASTER_URI": "http://localhost:11311", "ROS_HOME": f"{tmp_path}/ros"}
        for host in two.hosts.values():
            host.environment |= {**CONFINED, **ros1, "ROS_DOMAIN_ID": str(DOMAIN)}
        yield two


@pytest.fixture
def robot(server: Space) -> Iterator[Peer]:
    """Node of the robot."""
    del server
    with peer_of("robot") as peer:
        peer.tell("!" + _ROBOT)
        yield peer


@pytest.fixture
def desk(server: Space) -> Iterator[Peer]:
    """Application on the server."""
    with peer_of("desk", server.command([])) as peer:
        peer.tell("!" + _DESK)
        yield peer


class Reader:
    """Reader of the page who follows it section by section."""

    def __init__(self, machines: Machines) -> None:
        self._machines = machines

    def follow(self, heading: str) -> str:
        """Run every command of a section, those for ROS 2 where it is installed; return the output."""
        has_ros2 = shutil.which("ros2") is not None
        shown = [each for each in blocks_between(PAGE, heading) if has_ros2 or not each.title.endswith(_ROS2)]
        return self._machines.follow(each for each in shown if each.title)


@pytest.fixture
def reader(machines: Machines, robot: Peer, desk: Peer) -> Reader:
    """Reader who has followed the page up to the start."""
    made = Reader(machines)
    made.follow("What you need")
    made.follow("Keys")
    printed = made.follow("The two files")
    for file, right in (("robot", "publish"), ("server", "read")):
        assert f"{file}/proxy.yaml: + {right} topic /camera/left [sensor_msgs/msg/Image]" in printed
    made.follow("Start")
    return made


def test_a_robot_and_a_server_meet_by_the_commands_of_the_page(
    reader: Reader, machines: Machines, robot: Peer, desk: Peer
) -> None:
    desk.waits_for("len(heard['/camera/left']) > 0", True)
    robot.waits_for("len(heard['/cmd_vel']) > 0", True)
    desk.waits_for("client.wait_for_server(0.1)", True)
    desk.tell("!client.send_goal_async(Fibonacci.Goal(order=7)).add_done_callback(begun)")
    desk.waits_for("results", [7])

    looked = reader.follow("Look")
    assert "('/camera/left', ['sensor_msgs/msg/Image'])" in looked
    assert "frame_id='laser'" in looked
    assert "message='the lamp is True'" in looked
    assert "configuration good" in looked
    assert 'gdp_messages_total{direction="in"}' in looked

    desk.tell("listen(Odometry, '/odom')")
    assert "+ publish topic /odom" in reader.follow("Change")
    desk.waits_for("len(heard['/odom']) > 0", True)

    said = machines.end()
    assert sorted(said) == [f"gdp-{each}, exit 0" for each in ("proxy", "rib", "switch")]
    assert " 0 faults" in said["gdp-proxy, exit 0"]


@pytest.mark.nightly
def test_a_ros_1_server_sees_a_ros_2_robot_by_the_commands_of_the_page(reader: Reader, machines: Machines) -> None:
    need_ros1()
    machines.end("gdp-proxy --config server")
    looked = reader.follow("ROS 1")
    assert "/camera/left" in looked
    assert "Type: sensor_msgs/LaserScan" in looked
    assert 'frame_id: "laser"' in looked
    assert "the lamp is True" in looked
