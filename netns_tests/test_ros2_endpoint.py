"""Endpoint ``ros2`` and a real node on two apparent machines: two namespaces and a cable."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from lab.namespaces import wait_for_carrier
from netns_tests.spaces import Space
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
        with Space() as there:  # kept alive by a process that only waits
            there.ip("set", "lo", "up")
            holder = subprocess.Popen(["sleep", "300"])
            stack.callback(holder.wait)
            stack.callback(holder.kill)
        inside = ("nsenter", f"--net=/proc/{holder.pid}/ns/net")
        here = stack.enter_context(Space())
        here.ip("set", "lo", "up")
        here.veth("one", "two", bytes([2, 0, 0, 0, 0, 1]), bytes([2, 0, 0, 0, 0, 2]))
        here.ip("set", "two", "netns", str(holder.pid))
        for words in (
            ["ip", "address", "add", "10.9.9.1/24", "dev", "one"],
            [*inside, "ip", "address", "add", "10.9.9.2/24", "dev", "two"],
            [*inside, "ip", "link", "set", "two", "up"],
        ):
            subprocess.run(words, check=True)
        wait_for_carrier("one")
        peer = stack.enter_context(peer_of("far", inside, SUBNET))
        peer.tell("!from std_msgs.msg import String")
        yield peer


def test_a_message_crosses_the_sim_link_both_ways(far: Peer) -> None:
    far.tell("!out = talk(String, '/out'); listen(String, '/back')")
    command = [sys.executable, "-m", "netns_tests.ros2_child", str(DOMAIN), NODE]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, env={**os.environ, **SUBNET})
    try:
        far.waits_for("[i.node_name for i in node.get_publishers_info_by_topic('/back')]", [NODE])
        far.waits_for("out.get_subscription_count()", 1)
        far.tell("out.publish(String(data='hello'))")
        far.waits_for("[bytes.fromhex(raw)[8:13].decode() for raw in heard['/back']]", ["hello"])
    finally:
        child.communicate(timeout=10)
    assert child.returncode == 0
