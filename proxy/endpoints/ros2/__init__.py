"""A live ROS 2 graph through rclpy, whatever DDS vendor or RMW the robot runs.

``endpoint`` is what the proxy calls; ``waiting`` is the thread that hears; ``ends`` are the things it hears with;
``survey`` looks at the graph; ``session`` is the part of rclpy that all of them use.
"""

from proxy.endpoints.ros2.endpoint import Ros2Endpoint

__all__ = ["Ros2Endpoint"]
