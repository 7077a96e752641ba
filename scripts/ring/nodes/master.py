"""``python -m ring.nodes.master PORT``: the master of a ROS 1 graph, until killed.

Place: shell; imports rosmaster, which brings no types.
"""

from __future__ import annotations

import signal
import sys
from importlib import import_module

from proxy.endpoints.ros1.install import rospy_folder
from ring.nodes.orders import say


def main() -> None:
    """Serve, and say when."""
    sys.path.insert(0, rospy_folder())
    import_module("rosmaster.master").Master(int(sys.argv[1])).start()
    say("ready")
    while True:
        signal.pause()


if __name__ == "__main__":
    main()
