"""A node appears in the graph of another machine, and disappears with its process, its machine and its grant."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

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


@dataclass
class Site:
    """Two machines of one run; ``here``: a node that looks at the graph of the second."""

    pair: Pair
    here: Peer
    talkers: list[Peer] = field(default_factory=list)

    def takes_s(self, *nodes: str) -> float:
        """Return how many seconds pass until a graph has these far nodes alone."""
        begun_s = time.monotonic()
        until(lambda: self.here.tell(LIST) == [*nodes], nodes)
        return time.monotonic() - begun_s

    def end(self) -> None:
        """End the talkers."""
        for each in self.talkers:
            each.end()

    def talker(self) -> tuple[str, Peer]:
        """Return a node of the first machine, and its name, which no other has had; its proxy sees it."""
        name = f"far_talker_{len(self.talkers)}"
        node = self.pair.node("a", name)
        self.talkers.append(node)
        node.tell("!from std_msgs.msg import String; kept = [node.create_publisher(String, '/chatter', 1)]")
        node.waits_for("len(node.get_node_names()) > 1", True)
        return name, node

    def shown(self) -> tuple[str, Peer]:
        """Return a node when the graph of the other machine has it, and none of an earlier test."""
        name, node = self.talker()
        self.pair.proxy("b")
        self.takes_s(name)
        return name, node


@pytest.fixture(scope="module")
def machines() -> Iterator[Site]:
    with pair_of(NODES) as pair:
        here = pair._make_node("b", "here")
        here.tell(LIST)
        yield Site(pair, here)


@pytest.fixture
def site(machines: Site) -> Iterator[Site]:
    """The machines, whose talkers end with the test."""
    yield machines
    machines.end()


def test_the_first_far_node_is_there_soon_after_the_proxy_is(site: Site) -> None:
    name, _ = site.talker()
    site.pair._proxies["b"].end()  # it begins last
    site.pair.proxy("b")
    assert site.takes_s(name) <= FIRST_S
    publishers = f"[name for name, _ in node.get_publisher_names_and_types_by_node('{name}', '/')]"
    site.here.waits_for(publishers, ["/chatter", "/parameter_events", "/rosout"])


def test_a_far_node_goes_with_its_process(site: Site) -> None:
    _, there = site.shown()
    there.end()
    assert site.takes_s() <= GONE_S


def test_a_far_node_goes_while_its_machine_is_frozen(site: Site) -> None:
    name, _ = site.shown()
    pid = site.pair.proxy("a").pid
    os.kill(pid, signal.SIGSTOP)
    assert site.takes_s() <= GONE_S
    os.kill(pid, signal.SIGCONT)
    site.takes_s(name)


def test_a_far_node_goes_with_its_grant(site: Site) -> None:
    site.shown()
    for each in (site.pair.identity("a") / DELEGATIONS).iterdir():
        each.unlink()
    os.kill(site.pair.proxy("a").pid, signal.SIGHUP)
    assert site.takes_s() <= GONE_S
