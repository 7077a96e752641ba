"""``ros2 fog ...``: the ``fog`` command as a plug-in of ROS 2's own command line."""
