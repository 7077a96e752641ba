"""Endpoints: each speaks one dialect of ROS and knows nothing of names.

Place: I/O.
"""
