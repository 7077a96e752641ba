"""Plug-in of ROS 2's command line: the ``fog`` command as ``ros2 fog ...``."""
