"""Plug-in of ROS 2's command line: the ``gdp`` command and its programs as ``ros2 gdp ...``."""
