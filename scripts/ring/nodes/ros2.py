"""Node of ROS 2 for the roles of a live ring. I/O; imports rclpy."""

from __future__ import annotations

import threading
from array import array
from collections.abc import Callable
from typing import Any, Final

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

from ring.nodes.node import Call, Lamp, load_type

_DEPTH: Final = 50  # some seconds of pictures: Fast DDS may need three to request a lost sample


class Caller:
    """Client of a lamp."""

    def __init__(self, node: rclpy.node.Node, name: str, type_name: str) -> None:
        kind: Any = load_type(type_name)
        self._request = kind.Request
        self._client = node.create_client(kind, name)

    def wait(self, seconds: float) -> bool:
        """Return whether the service is available within this many seconds."""
        return bool(self._client.wait_for_service(timeout_sec=seconds))

    def call(self, *, on: bool, patience_s: float) -> Call | None:
        """Call the lamp; return the reply, None if none came within ``patience_s`` seconds."""
        request = self._request(data=on)
        came = threading.Event()
        future = self._client.call_async(request)
        future.add_done_callback(lambda _: came.set())
        if not came.wait(patience_s):
            self._client.remove_pending_request(future)
            return None
        response = future.result()
        size = len(serialize_message(request)) + len(serialize_message(response))
        return Call(response.success, response.message, size)


class Ros2Node:
    """A node that is spun in a thread of its own. The environment states the domain and the middleware."""

    def __init__(self, name: str) -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(name)
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        threading.Thread(target=executor.spin, name="spin", daemon=True).start()

    def publisher(self, topic: str, type_name: str, *, latched: bool) -> Callable[[object], None]:
        """Create a reliable publisher of a topic; return what publishes a message."""
        made = self._node.create_publisher(load_type(type_name), topic, _profile(latched=latched))
        publish: Callable[[object], None] = made.publish
        return publish

    def subscribe(self, topic: str, type_name: str, take: Callable[[object], None], *, latched: bool) -> None:
        """Subscribe to a topic."""
        self._node.create_subscription(load_type(type_name), topic, take, _profile(latched=latched))

    def serve(self, name: str, type_name: str, lamp: Lamp) -> None:
        """Create a ``SetBool`` server."""
        kind: Any = load_type(type_name)

        def answer(request: Any, response: Any) -> Any:
            response.success, response.message = lamp(request.data)
            return response

        self._node.create_service(kind, name, answer)

    def caller(self, name: str, type_name: str) -> Caller:
        """Create a ``SetBool`` client."""
        return Caller(self._node, name, type_name)

    def fit(self, values: array[int]) -> object:
        """Return the array itself."""
        return values

    def size(self, message: object) -> int:
        """Return the bytes of its CDR."""
        return len(serialize_message(message))


def _profile(*, latched: bool) -> QoSProfile:
    if latched:
        return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return QoSProfile(depth=_DEPTH)
