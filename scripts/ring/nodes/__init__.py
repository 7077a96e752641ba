"""The robot and the server of a live ring: ordinary ROS nodes, which know nothing of the overlay.

Place: processes of their own, ``python -m ring.nodes``. ``content`` is pure; ``ros1`` and ``ros2`` alone import
their ROS.
"""
