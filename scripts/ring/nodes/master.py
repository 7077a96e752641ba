"""Master of a ROS 1 graph: ``python -m ring.nodes.master PORT``, until killed.

I/O; imports rosmaster, which has no types.
"""

from __future__ import annotations

import signal
import sys
from importlib import import_module

from proxy.endpoints.ros1.install import rospy_folder
from ring.nodes.node import say


def main() -> None:
    """Serve, and report when ready."""
    sys.path.insert(0, rospy_folder())
    import_module("rosmaster.master").Master(int(sys.argv[1])).start()
    say("ready")
    while True:
        signal.pause()


if __name__ == "__main__":
    main()
