"""Stand-in for ROS 2's ``launch`` 3.4.3."""

from launch.core import Action, Event, LaunchContext, LaunchDescriptionEntity, LaunchService
from launch.launch_description import LaunchDescription

__all__ = ["Action", "Event", "LaunchContext", "LaunchDescription", "LaunchDescriptionEntity", "LaunchService"]
