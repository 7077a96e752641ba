"""ROS 1 endpoint of one graph: a rospy process per master (``child``), its counterpart in the proxy (``endpoint``), and
the IPC between them (``ipc``).

I/O. Only the process of ``child`` imports rospy, genpy and genmsg.
"""

from __future__ import annotations

from proxy.endpoints.ros1.endpoint import Ros1Endpoint

__all__ = ["Ros1Endpoint"]
