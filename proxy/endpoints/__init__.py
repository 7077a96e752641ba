"""Endpoints: each implements one dialect of ROS and has no knowledge of overlay names."""
