"""One ROS 1 graph: rospy in a process of its own per master (``child``), its twin in the proxy (``endpoint``), and the
wire between the two (``link``).

Place: I/O. Only the process of ``child`` imports rospy, genpy and genmsg.
"""

from __future__ import annotations

from proxy.endpoints.ros1.endpoint import Ros1Endpoint

__all__ = ["Ros1Endpoint"]
