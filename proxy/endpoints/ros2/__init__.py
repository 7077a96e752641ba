"""ROS 2 endpoint: a live graph through rclpy, with any DDS vendor or RMW of the robot.

``endpoint`` is the interface for the proxy. ``wait_thread`` receives through the ``entities``. ``graph_cache`` polls
the graph. ``session`` is the part of rclpy that all of them use.
"""

from proxy.endpoints.ros2.endpoint import Ros2Endpoint

__all__ = ["Ros2Endpoint"]
