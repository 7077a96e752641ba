"""Stand-in for ROS 2's ``launch``."""

from launch.core import Action, LaunchContext, LaunchService
from launch.launch_description import LaunchDescription

__all__ = ["Action", "LaunchContext", "LaunchDescription", "LaunchService"]
