"""Child process that runs rospy: ``python -m proxy.endpoints.ros1.child FD MASTER NODE INCARNATION DELAY_S``.

I/O. FD is its side of the IPC link; the process ends when the link does. INCARNATION counts such processes of one
endpoint; DELAY_S is how long this one stays off the graph, because an earlier one has failed.
"""

from __future__ import annotations

import os
import socket
import sys

from gdp.errors import LocalError
from proxy.endpoints.ros1.install import rospy_folder
from proxy.endpoints.ros1.ipc import IpcLink, Kind


def main() -> None:
    """Serve the IPC link until it ends."""
    descriptor, master, node, incarnation_id, delay_s = sys.argv[1:]
    woken = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
    link = IpcLink(socket.socket(fileno=int(descriptor)), lambda: os.eventfd_write(woken, 1))
    try:
        # This comes first: a ROS 2 of this interpreter has packages of the same names.
        sys.path.insert(0, rospy_folder())
        from proxy.endpoints.ros1.node import Node
    except (ImportError, LocalError) as error:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        reason = error if isinstance(error, LocalError) else f"rospy does not load in this Python {version}: {error}"
        link.send(Kind.ENDING, payload=str(reason).encode())
        sys.exit(1)
    Node(
        link=link, woken=woken, master=master, node=node, incarnation_id=int(incarnation_id), delay_s=float(delay_s)
    ).run()


if __name__ == "__main__":
    main()
