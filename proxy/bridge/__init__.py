"""Bridge between a live ROS graph and the overlay: the flows, and the rules that select them.

I/O through endpoints and the participant. ``desired_flows``, ``stream_qos`` and ``bridge_election`` are sans-I/O.
"""
