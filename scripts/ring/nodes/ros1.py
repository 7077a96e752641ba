"""Node of ROS 1 for the roles of a live ring; ``ros2`` has the same methods. I/O; imports rospy."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from io import BytesIO
from typing import Final

import rospy

from ring.nodes.node import Call, Lamp, load_type

_QUEUE: Final = 100


class Caller:
    """Client of a lamp."""

    def __init__(self, name: str, type_name: str) -> None:
        self._name = name
        self._call = rospy.ServiceProxy(name, load_type(type_name))

    def wait(self, seconds: float) -> bool:
        """Return whether the service is available within this many seconds."""
        try:
            rospy.wait_for_service(self._name, timeout=seconds)
        except rospy.ROSException:
            return False
        return True

    def call(self, *, on: bool, patience_s: float) -> Call | None:
        """Call the lamp; return the reply, None if none came within ``patience_s`` seconds."""
        del patience_s  # rospy has no timeout; the server must answer or refuse
        try:
            response = self._call(on)
        except rospy.ServiceException:
            return None
        return Call(response.success, response.message, 1 + _size(response))


class Ros1Node:
    """A node; rospy supplies the threads. The environment states the master's URI."""

    def __init__(self, name: str) -> None:
        rospy.init_node(name, disable_signals=True)

    def publisher(self, topic: str, type_name: str, *, latched: bool) -> Callable[[object], None]:
        """Create a publisher of a topic; return what publishes a message."""
        made = rospy.Publisher(topic, load_type(type_name), queue_size=_QUEUE, latch=latched)
        publish: Callable[[object], None] = made.publish
        return publish

    def subscribe(self, topic: str, type_name: str, take: Callable[[object], None], *, latched: bool) -> None:
        """Subscribe to a topic."""
        del latched  # the publisher decides it
        rospy.Subscriber(topic, load_type(type_name), take, buff_size=1 << 22, tcp_nodelay=True)

    def serve(self, name: str, type_name: str, lamp: Lamp) -> None:
        """Create a ``SetBool`` server."""
        rospy.Service(name, load_type(type_name), lambda request: lamp(request.data))

    def caller(self, name: str, type_name: str) -> Caller:
        """Create a ``SetBool`` client."""
        return Caller(name, type_name)

    def fit(self, values: array[int]) -> object:
        """Return bytes for ``uint8[]``, a list for any other."""
        return values.tobytes() if values.typecode == "B" else values.tolist()

    def size(self, message: object) -> int:
        """Return the bytes of its ROS 1 form."""
        return _size(message)


def _size(message: object) -> int:
    buffer = BytesIO()
    message.serialize(buffer)  # type: ignore[attr-defined]  # every message of genpy has it
    return buffer.tell()
