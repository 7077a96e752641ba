"""Actions of ``launch_ros``."""

from launch_ros.actions.node import Node

__all__ = ["Node"]
