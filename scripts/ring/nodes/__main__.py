"""Module entry ``python -m ring.nodes ROS NODE COUNT [HZ [ROWS]]``: ROS is 1 or 2; COUNT messages or calls, if any.

NODE: ``listener`` hears every talker, ``listener:camera`` one of them. HZ: a talker's messages a second, if not its
usual ones. ROWS: of the camera's pictures. Arguments of ROS may follow. ``1 master PORT`` is the master of a ROS 1
graph.

I/O.
"""

from __future__ import annotations

import signal
import sys
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import NoReturn

from ring.nodes import roles
from ring.nodes.content import TALKS, take_small_picture
from ring.nodes.node import Orders, say


def _node(ros: str, name: str) -> roles.Node:
    if ros == "2":
        from ring.nodes.ros2 import Ros2Node

        return Ros2Node(name)
    _find_ros1()
    from ring.nodes.ros1 import Ros1Node

    return Ros1Node(name)


def _find_ros1() -> None:
    from proxy.endpoints.ros1.install import rospy_folder

    sys.path.insert(0, rospy_folder())  # comes first: a ROS 2 of this interpreter has packages of the same names


def _be_master(port: int) -> NoReturn:
    _find_ros1()
    import_module("rosmaster.master").Master(port).start()  # it has no types
    say("ready")
    while True:
        signal.pause()


def main() -> None:
    """Run one of the nodes until killed."""
    ros, count = sys.argv[1], int(sys.argv[3])
    name, _, heard = sys.argv[2].partition(":")
    if name == "master":
        _be_master(count)
    orders = Orders()
    node = _node(ros, name)
    if name == "listener":
        roles.listen(node, orders, [talk for talk in TALKS if heard in ("", talk.node)])
    elif name == "lamp":
        roles.serve(node, orders)
    elif name == "caller":
        roles.call(node, orders, count)
    else:
        talk = next(talk for talk in TALKS if talk.node == name)
        if pace := sys.argv[4:]:
            talk = replace(talk, hz=float(pace[0]))
        if pace[1:] and name == "camera":
            talk = replace(talk, fill=partial(take_small_picture, int(pace[1])))
        roles.talk(node, orders, talk, count)


if __name__ == "__main__":
    main()
