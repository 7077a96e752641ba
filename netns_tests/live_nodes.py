"""Real rospy node, controlled line by line like ``ros2_peer``, and the values of a message of either ROS.

python netns_tests/live_nodes.py NODE

Each command is one line of Python with these names: ``rospy``, ``talk``, ``listen``, ``serve``, ``call``, ``heard``,
``values``; the answer is one line of JSON.
"""

from __future__ import annotations

import json
import sys
from collections import deque
from collections.abc import Callable

_PLAIN = (bool, int, float, str)


def values(message: object) -> object:
    """Return the values of all fields in order, without a header's ``seq``, which ROS 2 lacks."""
    if isinstance(message, _PLAIN):
        return message
    if isinstance(message, bytes):
        return list(message)
    if hasattr(message, "tolist"):  # of numpy or array
        return message.tolist()
    if isinstance(message, list | tuple):
        return [values(each) for each in message]
    fields = message.get_fields_and_field_types() if hasattr(message, "get_fields_and_field_types") else None
    return [values(getattr(message, each)) for each in fields or message.__slots__ if each != "seq"]  # type: ignore[attr-defined]


def main() -> None:
    """Serve commands until the input ends."""
    import rospy

    rospy.init_node(sys.argv[1], disable_signals=True)
    heard: dict[str, deque[object]] = {}

    def listen(kind: type, topic: str) -> None:
        heard[topic] = deque()
        rospy.Subscriber(topic, kind, lambda message: heard[topic].append(values(message)))

    def talk(kind: type, topic: str, *, latch: bool = False) -> object:
        return rospy.Publisher(topic, kind, queue_size=100, latch=latch)

    def serve(kind: type, name: str, work: Callable[[object], object]) -> object:
        return rospy.Service(name, kind, work)

    def call(kind: type, name: str, *request: object) -> object:
        """Call once; return the text of a refusal."""
        try:
            rospy.wait_for_service(name, timeout=10)
            return values(rospy.ServiceProxy(name, kind)(*request))
        except (rospy.ServiceException, rospy.ROSException) as error:
            return f"{type(error).__name__}: {error}"

    names = {
        "rospy": rospy, "heard": heard, "listen": listen, "talk": talk, "serve": serve, "call": call, "values": values,
    }  # fmt: skip
    for line in sys.stdin:
        try:
            is_statement = line.startswith("!")
            code = compile(line[is_statement:].replace("\\n", "\n"), "sent", "exec" if is_statement else "eval")
            print(json.dumps(eval(code, names), default=list), flush=True)
        except Exception as error:  # the test gets every error, whatever its type
            print(json.dumps(f"ERROR {error!r}"), flush=True)
    rospy.signal_shutdown("asked to")


if __name__ == "__main__":
    main()
