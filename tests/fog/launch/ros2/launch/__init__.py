"""Stand-in for ROS 2's ``launch`` 3.4.3; its imports are relative, so that its types are known under any name."""

from .core import Action, Event, LaunchContext, LaunchDescriptionEntity, LaunchService
from .launch_description import LaunchDescription

__all__ = ["Action", "Event", "LaunchContext", "LaunchDescription", "LaunchDescriptionEntity", "LaunchService"]
