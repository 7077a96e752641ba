"""Endpoint in a child process, as proxies are: it repeats on /back what it receives on /out, until its input ends.

python -m netns_tests.ros2_child DOMAIN NODE

Fast DDS looks for network interfaces once in a process, so one process cannot be in two namespaces.
"""

from __future__ import annotations

import select
import sys

from proxy.endpoints.core.endpoint import MessageReceived
from proxy.endpoints.ros2 import Ros2Endpoint

if __name__ == "__main__":
    endpoint = Ros2Endpoint(int(sys.argv[1]), sys.argv[2])
    endpoint.subscribe("/out", "std_msgs/msg/String", None)
    back = endpoint.advertise(endpoint.channel("/back", "std_msgs/msg/String"))
    while sys.stdin not in (ready := select.select([endpoint, sys.stdin], [], [])[0]):
        for event in endpoint.poll_events() if ready else ():
            if isinstance(event, MessageReceived):
                endpoint.publish(back, event.raw)
    endpoint.shut_down()
