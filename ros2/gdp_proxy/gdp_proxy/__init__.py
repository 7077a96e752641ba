"""ROS 2 package of the proxy."""
