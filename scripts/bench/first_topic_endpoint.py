"""Camera and viewer of ``first_topic.py``: ordinary rclpy nodes without knowledge of the overlay.

    python first_topic_endpoint.py camera|viewer TOPIC

The camera publishes small images ten times a second; the viewer prints a line of JSON when the first one comes.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Final

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image

_PERIOD_S: Final = 0.1
_SIDE: Final = 64


def main(role: str, topic: str) -> None:
    """Run a node until it is ended."""
    rclpy.init()
    node = rclpy.create_node(role)
    (_publish if role == "camera" else _read)(node, topic)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        return


def _publish(node: Node, topic: str) -> None:
    publisher = node.create_publisher(Image, topic, 10)
    image = Image(width=_SIDE, height=_SIDE, step=_SIDE, encoding="mono8", data=bytes(_SIDE * _SIDE))
    node.create_timer(_PERIOD_S, lambda: publisher.publish(image))
    _say(event="publishes")


def _read(node: Node, topic: str) -> None:
    seen = list[Image]()

    def take(image: Image) -> None:
        """Print when the first image came."""
        if not seen:
            _say(event="image", at_s=time.monotonic(), bytes=len(image.data))
        seen[:] = [image]

    node.create_subscription(Image, topic, take, 10)
    _say(event="reads")


def _say(**fields: object) -> None:
    print(json.dumps(fields), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
