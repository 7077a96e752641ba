"""Verbs of ros2cli as calls of rclpy, for ``ros2_peer``; it imports nothing of ours.

Each function returns what the verb prints, without what differs by chance: GIDs, times, order. Proxies and nodes of
these tests are left out.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
from geometry_msgs.msg import PointStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces import srv
from rcl_interfaces.msg import Log, Parameter, ParameterEvent
from rclpy.action import (
    ActionClient,
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci
from tf2_msgs.msg import TFMessage
from type_description_interfaces.srv import GetTypeDescription

_PATIENCE_S = 20.0
_OURS = ("gdp_proxy_", "_")
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def node_list(node: Node) -> object:
    return sorted(f"{space.rstrip('/')}/{name}" for name, space in _nodes(node))


def node_info(node: Node, name: str) -> object:
    graph = [node.get_publisher_names_and_types_by_node, node.get_subscriber_names_and_types_by_node]
    graph += [node.get_service_names_and_types_by_node, node.get_client_names_and_types_by_node]
    plain = [_visible(each(name, "/")) for each in graph]
    actions = get_action_server_names_and_types_by_node, get_action_client_names_and_types_by_node
    return [*plain, *(sorted(each(node, name, "/")) for each in actions)]


def topic_list(node: Node) -> object:
    return _visible(node.get_topic_names_and_types())


def topic_info(node: Node, topic: str) -> object:
    found = node.get_publishers_info_by_topic(topic), node.get_subscriptions_info_by_topic(topic)
    return [
        sorted(
            [
                each.node_name,
                each.node_namespace,
                each.topic_type,
                str(each.topic_type_hash),
                each.qos_profile.reliability.name,
                each.qos_profile.durability.name,
                each.qos_profile.liveliness.name,
                each.qos_profile.deadline.nanoseconds,
                each.qos_profile.lifespan.nanoseconds,
            ]
            for each in ends
            if not each.node_name.startswith(_OURS)
        )
        for ends in found
    ]


def topic_echo(node: Node) -> object:
    return _first(node, String, "/chatter", 10).data


def topic_hz(node: Node) -> object:
    return [_first(node, String, "/chatter", 10, count=5).data, _first(node, PointStamped, "/point", _sensor()).point.x]


def bag_record(node: Node) -> object:
    """Return which topics bring messages as bytes, by which a recorder takes every type."""
    types = dict(node.get_topic_names_and_types())
    raws: dict[str, bytes] = {}
    kinds = {"std_msgs/msg/String": String, "geometry_msgs/msg/PointStamped": PointStamped}
    taken = [
        node.create_subscription(
            kinds[types[topic][0]], topic, lambda raw, topic=topic: raws.setdefault(topic, raw), _sensor(), raw=True
        )
        for topic in ("/chatter", "/point")
    ]
    try:
        return _until(lambda: len(raws) == len(taken)), {topic: len(raw) for topic, raw in sorted(raws.items())}
    finally:
        for each in taken:
            node.destroy_subscription(each)


def topic_delay(node: Node) -> object:
    stamp = _first(node, PointStamped, "/point", _sensor()).header.stamp
    return abs(node.get_clock().now().nanoseconds / 1e9 - stamp.sec - stamp.nanosec / 1e9) < _PATIENCE_S


def topic_pub(node: Node) -> object:
    publisher = node.create_publisher(String, "/cmd", 10)
    texts: list[str] = []
    heard = node.create_subscription(String, "/heard", lambda message: texts.append(message.data), _LATCHED)
    timer = node.create_timer(0.2, lambda: publisher.publish(String(data=node.get_name())))
    try:
        return _until(lambda: node.get_name() in texts)
    finally:
        node.destroy_timer(timer)
        node.destroy_publisher(publisher)
        node.destroy_subscription(heard)


def rosout(node: Node) -> object:
    lines: list[str] = []
    heard = node.create_subscription(Log, "/rosout", lambda message: lines.append(message.msg), 1000)
    try:
        return _until(lambda: service_call(node) and "armed: True" in lines)
    finally:
        node.destroy_subscription(heard)


def service_list(node: Node) -> object:
    own = (f"/{node.get_name()}/", "/_")
    return [each for each in sorted(node.get_service_names_and_types()) if not each[0].startswith(own)]


def service_call(node: Node) -> object:
    response = _call(node, SetBool, "/arm", SetBool.Request(data=True))
    return [response.success, response.message]


def param_list(node: Node, name: str) -> list[str]:
    return sorted(_call(node, srv.ListParameters, f"{name}/list_parameters").result.names)


def param_get(node: Node, *names: str) -> list[Any]:
    values = _call(node, srv.GetParameters, "/talker/get_parameters", srv.GetParameters.Request(names=names)).values
    return [parameter_value_to_python(each) for each in values]


def param_dump(node: Node) -> object:
    names = param_list(node, "/talker")
    return [names, param_get(node, *names)]


def param_set(node: Node) -> object:
    found = [
        _set(node, "label", "rear"),
        param_get(node, "label"),
        _set(node, "label", "front"),
        _set(node, "rate", 99.0),
    ]
    events: list[str] = []
    heard = node.create_subscription(ParameterEvent, "/parameter_events", lambda event: events.append(event.node), 10)
    try:
        return [*found, _until(lambda: _set(node, "count", 3) and "/talker" in events)]
    finally:
        node.destroy_subscription(heard)


def param_load(node: Node) -> object:
    request = srv.SetParametersAtomically.Request(parameters=[_parameter("count", 4), _parameter("label", "front")])
    result = _call(node, srv.SetParametersAtomically, "/talker/set_parameters_atomically", request).result
    return [result.successful, param_get(node, "count", "label"), _set(node, "count", 3)]


def param_describe(node: Node) -> object:
    request = srv.DescribeParameters.Request(names=["rate", "label"])
    types = srv.GetParameterTypes.Request(names=["rate", "label"])
    described = _call(node, srv.DescribeParameters, "/talker/describe_parameters", request).descriptors
    return [
        [repr(each) for each in described],
        list(_call(node, srv.GetParameterTypes, "/talker/get_parameter_types", types).types),
    ]


def type_description(node: Node) -> object:
    (end,) = [each for each in node.get_publishers_info_by_topic("/chatter") if each.node_name == "talker"]
    request = GetTypeDescription.Request(type_name="std_msgs/msg/String", type_hash=str(end.topic_type_hash))
    response = _call(node, GetTypeDescription, "/talker/get_type_description", request)
    return [response.successful, response.failure_reason, repr(response.type_description)]


def action_list(node: Node) -> object:
    return sorted(get_action_names_and_types(node))


def action_info(node: Node) -> object:
    by_node = get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node
    return [
        sorted(name for name, space in _nodes(node) if any(action == "/count" for action, _ in of(node, name, space)))
        for of in by_node
    ]


def action_send_goal(node: Node) -> object:
    client, feedback = ActionClient(node, Fibonacci, "/count"), list[list[int]]()
    try:
        assert client.wait_for_server(_PATIENCE_S)
        sent = client.send_goal_async(
            Fibonacci.Goal(order=3), lambda message: feedback.append(list(message.feedback.sequence))
        )
        goal = _result(sent)
        result = _result(goal.get_result_async())
        return [goal.accepted, _until(lambda: feedback) and feedback, result.status, list(result.result.sequence)]
    finally:
        client.destroy()


def lifecycle_nodes(node: Node) -> object:
    kinds = ["lifecycle_msgs/srv/GetState"]
    return sorted(name for name, types in node.get_service_names_and_types() if types == kinds)


def lifecycle_list(node: Node) -> object:
    found = _call(node, GetAvailableTransitions, "/driver/get_available_transitions").available_transitions
    return sorted([each.transition.label, each.start_state.label, each.goal_state.label] for each in found)


def lifecycle_get(node: Node) -> object:
    return _call(node, GetState, "/driver/get_state").current_state.label


def lifecycle_set(node: Node) -> object:
    states = list[object]()
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP):
        request = ChangeState.Request(transition=Transition(id=transition))
        states += [_call(node, ChangeState, "/driver/change_state", request).success, lifecycle_get(node)]
    return states


def component_list(node: Node) -> object:
    """Return the components of each container, which its hidden services name."""
    kinds = ["composition_interfaces/srv/ListNodes"]
    names = sorted(name for name, types in node.get_service_names_and_types() if types == kinds)
    found = {name: _call(node, ListNodes, name) for name in names}
    return {name: [list(each.full_node_names), list(each.unique_ids)] for name, each in found.items()}


def component_load(node: Node) -> object:
    request = LoadNode.Request(package_name="demo", plugin_name="demo::Component", node_name="part")
    loaded = _call(node, LoadNode, "/container/_container/load_node", request)
    request.plugin_name = "demo::Unknown"
    refused = _call(node, LoadNode, "/container/_container/load_node", request)
    return [loaded.success, loaded.full_node_name, loaded.unique_id, refused.error_message, component_list(node)]


def component_unload(node: Node) -> object:
    unloaded = [
        _call(node, UnloadNode, "/container/_container/unload_node", UnloadNode.Request(unique_id=1)) for _ in range(2)
    ]
    return [[[each.success, each.error_message] for each in unloaded], component_list(node)]


def tf2_monitor(node: Node) -> object:
    """Return each frame with its parent, and whether the moving ones are new."""
    frames = _frames(node)
    now_ns = node.get_clock().now().nanoseconds
    moving = [stamp for name, stamp in frames.items() if name != "camera"]
    stamps = [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for each in moving]
    fresh = all(abs(now_ns - each) < _PATIENCE_S * 1e9 for each in stamps)
    return {name: each.header.frame_id for name, each in sorted(frames.items())}, fresh


def tf2_echo(node: Node) -> object:
    """Return where the camera is on the map; all frames turn about z."""
    frames, name = _frames(node), "camera"
    x, turns = 0.0, 0
    while name != "map":
        step = frames[name].transform
        is_turned = step.rotation.z == 1.0
        x, turns = step.translation.x + (-x if is_turned else x), turns + is_turned
        name = frames[name].header.frame_id
    return [x, turns]


def _frames(node: Node) -> dict[str, TransformStamped]:
    frames: dict[str, TransformStamped] = {}

    def take(message: TFMessage) -> None:
        frames.update({each.child_frame_id: each for each in message.transforms})

    heard = [
        node.create_subscription(TFMessage, "/tf", take, 100),
        node.create_subscription(TFMessage, "/tf_static", take, _LATCHED),
    ]
    try:
        assert _until(lambda: {"odom", "base_link", "camera"} <= frames.keys()), frames
        return frames
    finally:
        for each in heard:
            node.destroy_subscription(each)


def _nodes(node: Node) -> list[tuple[str, str]]:
    return [each for each in node.get_node_names_and_namespaces() if not each[0].startswith(_OURS)]


def _visible(found: list[tuple[str, list[str]]]) -> list[tuple[str, list[str]]]:
    return sorted(each for each in found if "/_" not in each[0])


def _sensor() -> QoSProfile:
    return qos_profile_sensor_data


def _until(is_met: Callable[[], object]) -> bool:
    pause = threading.Event()
    for _ in range(int(_PATIENCE_S / 0.05)):
        if is_met():
            return True
        pause.wait(0.05)
    return False


def _first(node: Node, kind: type, topic: str, qos: QoSProfile | int, count: int = 1) -> Any:
    messages: list[object] = []
    subscription = node.create_subscription(kind, topic, messages.append, qos)
    try:
        assert _until(lambda: len(messages) >= count), topic
        return messages[-1]
    finally:
        node.destroy_subscription(subscription)


def _result(future: Any) -> Any:
    assert _until(future.done)
    return future.result()


def _call(node: Node, kind: Any, name: str, request: object = None) -> Any:
    client = node.create_client(kind, name)
    try:
        assert client.wait_for_service(_PATIENCE_S), name
        return _result(client.call_async(kind.Request() if request is None else request))
    finally:
        node.destroy_client(client)


def _parameter(name: str, value: object) -> Parameter:
    from rclpy.parameter import Parameter as Value

    return Value(name, value=value).to_parameter_msg()


def _set(node: Node, name: str, value: object) -> object:
    request = srv.SetParameters.Request(parameters=[_parameter(name, value)])
    (result,) = _call(node, srv.SetParameters, "/talker/set_parameters", request).results
    return [result.successful, result.reason]
