"""Two nodes of a robot for ``ros2_peer``: ``/talker`` has one of each kind of entity, ``/driver`` has a lifecycle."""

from __future__ import annotations

from geometry_msgs.msg import PointStamped
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.action import ActionServer
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

_PERIOD_S = 0.05
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def begin(node: Node) -> list[object]:
    """Give a node its entities, and start the other one; return what must stay."""
    within = ParameterDescriptor(
        description="hertz", floating_point_range=[FloatingPointRange(from_value=1.0, to_value=50.0)]
    )
    node.declare_parameter("rate", 10.0, within)
    node.declare_parameters("", [("label", "front"), ("count", 3)])
    chatter, point = (
        node.create_publisher(String, "/chatter", 10),
        node.create_publisher(PointStamped, "/point", _SENSOR),
    )
    heard = node.create_publisher(String, "/heard", _LATCHED)

    def tick() -> None:
        chatter.publish(String(data="hello"))
        stamped = PointStamped()
        stamped.header.stamp = node.get_clock().now().to_msg()
        point.publish(stamped)

    def arm(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        node.get_logger().info(f"armed: {request.data}")
        response.success, response.message = True, f"armed: {request.data}"
        return response

    def count(goal: object) -> Fibonacci.Result:
        goal.publish_feedback(Fibonacci.Feedback(sequence=[0, 1]))  # type: ignore[attr-defined]
        goal.succeed()  # type: ignore[attr-defined]
        return Fibonacci.Result(sequence=[0, 1, 1])

    driver = LifecycleNode("driver")
    assert node.executor is not None
    node.executor.add_node(driver)
    return [
        driver,
        node.create_timer(_PERIOD_S, tick),
        node.create_subscription(String, "/cmd", heard.publish, 10),
        node.create_service(SetBool, "/arm", arm),
        node.create_client(Trigger, "/elsewhere"),
        ActionServer(node, Fibonacci, "/count", count),
    ]
