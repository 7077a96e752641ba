"""Nodes of a live ring: ordinary ROS nodes for robot and server, which do not use the overlay.

I/O; processes of their own, ``python -m ring.nodes``. ``content`` is sans-I/O; only ``ros1`` and ``ros2`` import their
ROS.
"""
