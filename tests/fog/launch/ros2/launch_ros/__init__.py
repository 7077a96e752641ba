"""Stand-in for ROS 2's ``launch_ros`` 0.26.6."""
