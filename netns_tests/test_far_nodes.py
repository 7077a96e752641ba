"""A node appears in the graph of another machine, and disappears with its process, its machine and its grant."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import pytest

from gdp.intervals import SERVER
from gdp.ros_names import NODE_TYPE
from gdp.stores.keyring import DELEGATIONS
from lab.process import until
from netns_tests.live_pair import Crossing, Pair, pair_of
from tests.proxy.endpoints.ros2_net import Peer

pytestmark = pytest.mark.netns

NODES = Crossing("/far_*", NODE_TYPE, "a", "b", kind="node")
FIRST_S = 2.0  # from the moment when the proxy is attached
GONE_S = SERVER.lease_s + 1.0
LIST = "sorted(name for name, _ in node.get_node_names_and_namespaces() if name.startswith('far_'))"


@pytest.fixture
def pair() -> Iterator[Pair]:
    with pair_of(NODES) as made:
        yield made


def takes_s(peer: Peer, nodes: list[str]) -> float:
    """Return how many seconds pass until a graph has these far nodes."""
    begun_s = time.monotonic()
    until(lambda: peer.tell(LIST) == nodes, nodes)
    return time.monotonic() - begun_s


def shown(pair: Pair) -> tuple[Peer, Peer]:
    """Return a node that is to appear, and one that sees it; the proxy of the latter begins last."""
    there = pair.node("a", "far_talker")
    there.tell("!from std_msgs.msg import String; kept = [node.create_publisher(String, '/chatter', 1)]")
    here = pair._make_node("b", "here")
    here.tell(LIST)
    pair.proxy("b")
    return there, here


def test_the_first_far_node_is_there_soon_after_the_proxy_is(pair: Pair) -> None:
    _, here = shown(pair)
    assert takes_s(here, ["far_talker"]) <= FIRST_S
    assert here.tell("[name for name, _ in node.get_publisher_names_and_types_by_node('far_talker', '/')]") == [
        "/chatter", "/parameter_events", "/rosout"
    ]  # fmt: skip


def test_a_far_node_goes_with_its_process(pair: Pair) -> None:
    there, here = shown(pair)
    takes_s(here, ["far_talker"])
    there.end()
    assert takes_s(here, []) <= GONE_S


def test_a_far_node_goes_while_its_machine_is_frozen(pair: Pair) -> None:
    _, here = shown(pair)
    takes_s(here, ["far_talker"])
    pid = pair.proxy("a").pid
    os.kill(pid, signal.SIGSTOP)
    assert takes_s(here, []) <= GONE_S
    os.kill(pid, signal.SIGCONT)
    takes_s(here, ["far_talker"])


def test_a_far_node_goes_with_its_grant(pair: Pair) -> None:
    _, here = shown(pair)
    takes_s(here, ["far_talker"])
    for each in (pair.identity("a") / DELEGATIONS).iterdir():
        each.unlink()
    os.kill(pair.proxy("a").pid, signal.SIGHUP)
    assert takes_s(here, []) <= GONE_S
