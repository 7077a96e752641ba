"""Camera and viewer of ``first_topic.py``: ordinary rclpy nodes without knowledge of the overlay.

Process of its own. The camera publishes small images ten times a second; the viewer prints when the first one comes.
"""

from __future__ import annotations

import time
from typing import Final

from peers.jsonl import say
from ros_endpoint import End, Settings, reliable, run_role
from sensor_msgs.msg import Image

_PERIOD_S: Final = 0.1
_SIDE: Final = 64


def camera(end: End, settings: Settings) -> None:
    """Publish until killed."""
    publisher = end.node.create_publisher(Image, str(settings["topic"]), reliable())
    image = Image(width=_SIDE, height=_SIDE, step=_SIDE, encoding="mono8", data=bytes(_SIDE * _SIDE))
    end.every(_PERIOD_S, lambda: publisher.publish(image))
    say(event="publishes")
    end.run()


def viewer(end: End, settings: Settings) -> None:
    """Read until the first image."""
    end.node.create_subscription(Image, str(settings["topic"]), lambda _: end.finish(), reliable())
    say(event="reads")
    end.run()
    say(event="image", at_s=time.monotonic())


if __name__ == "__main__":
    run_role({"camera": camera, "viewer": viewer})
