"""Nodes of a robot for ``ros2_peer``: ``/talker`` has one of each kind of entity, ``/driver`` has a lifecycle.

``/container`` holds components, as one of rclcpp_components does.
"""

from __future__ import annotations

import rclpy
from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
from geometry_msgs.msg import PointStamped, TransformStamped
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.action import ActionServer
from rclpy.executors import Executor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci
from tf2_msgs.msg import TFMessage

_PERIOD_S = 0.05
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


class _Container:
    """Node whose components are empty nodes."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._node = rclpy.create_node("container")
        self._components: dict[int, Node] = {}
        executor.add_node(self._node)
        own = "/container/_container"
        self._node.create_service(ListNodes, f"{own}/list_nodes", self._list)
        self._node.create_service(LoadNode, f"{own}/load_node", self._load)
        self._node.create_service(UnloadNode, f"{own}/unload_node", self._unload)

    def _list(self, _: ListNodes.Request, response: ListNodes.Response) -> ListNodes.Response:
        response.full_node_names = [each.get_fully_qualified_name() for each in self._components.values()]
        response.unique_ids = list(self._components)
        return response

    def _load(self, request: LoadNode.Request, response: LoadNode.Response) -> LoadNode.Response:
        if request.plugin_name != "demo::Component":
            response.error_message = f"no {request.plugin_name} in {request.package_name}"
            return response
        component = rclpy.create_node(request.node_name, namespace=request.node_namespace)
        response.success, response.unique_id = True, max(self._components, default=0) + 1
        response.full_node_name = component.get_fully_qualified_name()
        self._components[response.unique_id] = component
        self._executor.add_node(component)
        return response

    def _unload(self, request: UnloadNode.Request, response: UnloadNode.Response) -> UnloadNode.Response:
        component = self._components.pop(request.unique_id, None)
        if component is None:
            response.error_message = f"no component {request.unique_id}"
            return response
        self._executor.remove_node(component)
        component.destroy_node()
        response.success = True
        return response


def _transform(node: Node, parent: str, child: str, x: float, *, turned: bool) -> TransformStamped:
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id, stamped.header.stamp = parent, node.get_clock().now().to_msg()
    stamped.transform.translation.x = x
    stamped.transform.rotation.z, stamped.transform.rotation.w = (1.0, 0.0) if turned else (0.0, 1.0)
    return stamped


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

    frames = node.create_publisher(TFMessage, "/tf", 100)
    static = node.create_publisher(TFMessage, "/tf_static", _LATCHED)
    static.publish(TFMessage(transforms=[_transform(node, "base_link", "camera", 0.5, turned=False)]))

    def tick() -> None:
        odometry = (
            _transform(node, "map", "odom", 3.0, turned=True),
            _transform(node, "odom", "base_link", 1.0, turned=False),
        )
        frames.publish(TFMessage(transforms=odometry))
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
        _Container(node.executor),
        node.create_timer(_PERIOD_S, tick),
        node.create_subscription(String, "/cmd", heard.publish, 10),
        node.create_service(SetBool, "/arm", arm),
        node.create_client(Trigger, "/elsewhere"),
        ActionServer(node, Fibonacci, "/count", count),
    ]
