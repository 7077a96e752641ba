"""Between a live ROS graph and the overlay: which local things are global, and the flows that carry them.

Place: shell; endpoints and the member do the I/O. ``wishes``, ``qos`` and ``rivals`` think.
"""
