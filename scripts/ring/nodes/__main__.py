"""Module entry ``python -m ring.nodes ROS NODE COUNT [HZ]``: ROS is 1 or 2; COUNT messages or calls, if it has any.

HZ: a talker's messages a second, if not its usual ones.

I/O.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from ring.nodes import roles
from ring.nodes.content import TALKS
from ring.nodes.node import Node
from ring.nodes.orders import Orders


def _node(ros: str, name: str) -> Node:
    if ros == "2":
        from ring.nodes.ros2 import Ros2Node

        return Ros2Node(name)
    from proxy.endpoints.ros1.install import rospy_folder

    sys.path.insert(0, rospy_folder())  # comes first: a ROS 2 of this interpreter has packages of the same names
    from ring.nodes.ros1 import Ros1Node

    return Ros1Node(name)


def main() -> None:
    """Run one of the nodes until killed."""
    ros, name, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    orders = Orders()
    node = _node(ros, name)
    if name == "listener":
        roles.listen(node, orders, TALKS)
    elif name == "lamp":
        roles.serve(node, orders)
    elif name == "caller":
        roles.call(node, orders, count)
    else:
        talk = next(talk for talk in TALKS if talk.node == name)
        roles.talk(node, orders, replace(talk, hz=float(sys.argv[4])) if len(sys.argv) > 4 else talk, count)


if __name__ == "__main__":
    main()
