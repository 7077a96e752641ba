"""Endpoint ``ros2`` and a real node on two apparent machines: two namespaces and a cable."""

from __future__ import annotations

import select
import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from lab.machine import LabMachine
from lab.namespaces import Space, cable
from lab.process import calling
from proxy.endpoints.core.endpoint import MessageReceived
from proxy.endpoints.ros2 import Ros2Endpoint
from tests.proxy.endpoints.ros2_net import DOMAIN, NODE, Peer, needs, peer_of

needs("std_msgs")
if shutil.which("nsenter") is None:
    pytest.skip("nsenter is not installed (util-linux)", allow_module_level=True)

pytestmark = pytest.mark.netns

SUBNET = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}


@pytest.fixture
def far() -> Iterator[Peer]:
    """Node at the other end of the cable; the test itself is at this end."""
    with ExitStack() as stack:
        here = stack.enter_context(Space())
        there = stack.enter_context(cable(here))
        for number, space in enumerate((here, there), 1):
            space.ip("address", "add", f"10.9.9.{number}/24", "dev", "eth0")
        peer = stack.enter_context(peer_of("far", there.command([]), SUBNET))
        peer.tell("!from std_msgs.msg import String")
        yield peer


def repeat(domain: str, node: str) -> None:
    """Repeat on /back what comes on /out, until the input ends; a process of its own.

    Fast DDS looks for network interfaces once in a process, so one process cannot be in two namespaces.
    """
    endpoint = Ros2Endpoint(int(domain), node)
    endpoint.subscribe("/out", "std_msgs/msg/String", None)
    back = endpoint.advertise(endpoint.channel("/back", "std_msgs/msg/String"))
    while sys.stdin not in (ready := select.select([endpoint, sys.stdin], [], [])[0]):
        for event in endpoint.poll_events() if ready else ():
            if isinstance(event, MessageReceived):
                endpoint.publish(back, event.raw)
    endpoint.shut_down()


def test_a_message_crosses_the_sim_link_both_ways(far: Peer, tmp_path: Path) -> None:
    far.tell("!out = talk(String, '/out'); listen(String, '/back')")
    with LabMachine(tmp_path, environment=SUBNET) as machine:
        child = machine.launch(calling(repeat, DOMAIN, NODE), has_orders=True)
        far.waits_for("[i.node_name for i in node.get_publishers_info_by_topic('/back')]", [NODE])
        far.waits_for("out.get_subscription_count()", 1)
        far.tell("out.publish(String(data='hello'))")
        far.waits_for("[bytes.fromhex(raw)[8:13].decode() for raw in heard['/back']]", ["hello"])
        child.close_orders()
        child.output()
