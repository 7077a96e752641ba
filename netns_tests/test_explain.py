"""``gdp explain`` on two real machines with ROS 2 nodes, a switch and a proxy each: faults that come and go."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from gdp.cli.fact_gathering import FactGathering, local_directory
from gdp.crypto.certificates import Role
from gdp.diagnosis.answer import Answer, Cause
from gdp.diagnosis.diagnosis import diagnose
from gdp.host.ros_processes import ros_processes
from gdp.intervals import ADVERTISEMENT
from lab.machine import GDP
from lab.process import until
from netns_tests.live_pair import Crossing, Pair, pair_of
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs", "std_srvs")
pytestmark = [pytest.mark.netns, pytest.mark.momentary("a diagnosis takes seconds")]

STRING, SET_BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
CROSSINGS = (
    Crossing("/pulse", STRING, "a", "b"),
    Crossing("/unread", STRING, "a", "b"),
    Crossing("/unpublished", STRING, "a", "b"),
    Crossing("/slow", STRING, "a", "b", options={"max_hz": 0.01}),
    Crossing("/one_sided", STRING, "", "b"),
    Crossing("/gate", SET_BOOL, "a", "b", "service"),
)
_NODE = """
from std_msgs.msg import String
from std_srvs.srv import SetBool
def beat(topic, hz):
    out = talk(String, topic)
    kept.append(node.create_timer(1 / hz, lambda: out.publish(String(data='beat'))))
def hear(topic):
    listen(String, topic)
def serve_gate():
    def answer(request, response):
        response.success = True
        return response
    kept.append(node.create_service(SetBool, '/gate', answer))
"""
_PATIENCE_S = 20.0
_WINDOW_S = 0.5


class Asked:
    """A pair on which ``gdp explain`` is typed, at machine b."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self.talker = self._node("a", "talker")
        self.listener = self._node("b", "listener")
        for topic, hz in (("/pulse", 10), ("/unread", 10), ("/slow", 10)):
            self.talker.tell(f"!beat('{topic}', {hz})")
        for topic in ("/pulse", "/unpublished", "/slow", "/one_sided"):
            self.listener.tell(f"!hear('{topic}')")
        self.talker.tell("!serve_gate()")
        self.listener.tell("!kept.append(node.create_client(SetBool, '/gate'))")
        until(lambda: self.listener.tell("len(heard['/pulse'])"), "the first message")

    def explain(self, name: str, *, directly: bool = False) -> Answer:
        """Return the answer about a name; ``directly``: every node is asked through its own control socket."""
        nodes = [local_directory(str(each)) for each in self.nodes(directly=directly)]
        gathering = FactGathering(name, nodes[0], nodes[1:])
        before, begun_s = gathering.sample(with_host=False), time.monotonic()
        time.sleep(_WINDOW_S)  # the counters of two moments are compared
        return diagnose(gathering.sample().since(before, time.monotonic() - begun_s))

    def type(self, name: str) -> tuple[int, Mapping[str, object]]:
        """Type the command at machine b; return its exit code and its JSON object."""
        given = ["--node", str(self.pair.identity("b")), "--seconds", "0.5", "--json"]
        ended = self.pair.machines["b"].run(*GDP, "explain", name, *given)
        assert ended.stdout, ended.stderr
        return ended.returncode, json.loads(ended.stdout)

    def nodes(self, *, directly: bool) -> list[Path]:
        """Return the directories of the nodes to ask, that of the near proxy first."""
        near, identity = self.pair.identity("b"), self.pair.identity
        others = [identity("b", Role.SWITCH), identity("a", Role.SWITCH), identity("a", Role.RIB), identity("a")]
        return [near, *others] if directly else [near, identity("b", Role.SWITCH)]

    def until_named(self, name: str, cause: Cause, *, directly: bool = False) -> None:
        """Ask until the cause is named: a fault takes a while to show."""
        answers: list[Answer] = []

        def is_named() -> bool:
            answers.append(self.explain(name, directly=directly))
            return answers[-1].cause is cause

        until(is_named, lambda: f"{cause.value}: {answers[-1]}", _PATIENCE_S)

    def tc(self, machine: str, device: str, *words: str) -> None:
        """Run ``tc qdisc`` on a machine."""
        command = ["tc", "qdisc", words[0], "dev", device, "root", *words[1:]]
        self.pair.machines[machine].output(*command)

    def _node(self, graph: str, name: str) -> Peer:
        node = self.pair.node(graph, name)
        node.tell("!" + _NODE)
        return node


@pytest.fixture(scope="module")
def asked() -> Iterator[Asked]:
    with pair_of(*CROSSINGS, lease_s=ADVERTISEMENT.lease_s) as pair:
        yield Asked(pair)


@contextmanager
def healed(asked: Asked) -> Iterator[None]:
    """Return to a flowing topic after a fault."""
    yield
    asked.until_named("/pulse", Cause.ARRIVES)


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("/pulse", Cause.ARRIVES),
        ("/gate", Cause.ARRIVES),
        ("/unread", Cause.NO_READER_HERE),
        ("/unpublished", Cause.NO_PUBLISHER),
        ("/one_sided", Cause.NOT_EXPOSED),
        ("/pulze", Cause.NAME_UNKNOWN),
        ("/slow", Cause.RATE_LIMIT),
    ],
)
def test_a_standing_condition_is_named(asked: Asked, name: str, cause: Cause) -> None:
    asked.until_named(name, cause)


def test_the_command_says_it_in_json_and_by_its_exit_code(asked: Asked) -> None:
    code, answer = asked.type("/pulse")
    assert (code, answer["verdict"], answer["command"]) == (0, "fine", None)
    code, answer = asked.type("/unread")
    assert (code, answer["cause"], answer["command"]) == (1, "no-reader-here", "ros2 topic echo /unread")


@pytest.mark.nightly
def test_a_ros_node_in_another_domain_or_with_shared_memory_alone_is_found(asked: Asked) -> None:
    words = asked.pair.spaces["b"].command(["env", "ROS_DOMAIN_ID=7", "FASTDDS_BUILTIN_TRANSPORTS=SHM"])
    apart = Peer("apart", words)
    try:
        apart.tell("1")
        proxy = asked.pair.proxy("b").pid
        found = ros_processes(frozenset({proxy}), proxy)
    finally:
        apart.end()
    assert [(each.transports, each.is_apart) for each in found if each.domain == 7] == [("SHM", False)]
    assert proxy not in {each.pid for each in found}


def test_a_cut_link_is_named_and_heals(asked: Asked) -> None:
    with healed(asked):
        asked.pair.spaces.cut("a", "b")
        try:
            asked.until_named("/pulse", Cause.INTERFACE_DOWN)
        finally:
            asked.pair.spaces.restore_link("a", "b")


@pytest.mark.nightly
def test_a_link_that_loses_all_our_frames_is_named_and_heals(asked: Asked) -> None:
    with healed(asked):
        asked.tc("a", "b", "add", "pfifo", "limit", "0")
        asked.tc("b", "a", "add", "pfifo", "limit", "0")
        try:
            asked.until_named("/pulse", Cause.LINK_SILENT)
            asked.until_named("/pulse", Cause.ETHERTYPE_FILTERED, directly=True)
        finally:
            asked.tc("a", "b", "del")
            asked.tc("b", "a", "del")


@pytest.mark.nightly
def test_a_killed_far_proxy_is_named_and_heals(asked: Asked) -> None:
    with healed(asked):
        asked.pair.proxy("a").end(signal.SIGKILL)
        try:
            asked.until_named("/pulse", Cause.FAR_PROXY_DOWN, directly=True)
        finally:
            asked.pair.proxy("a")


@pytest.mark.nightly
def test_a_near_proxy_that_does_not_run_is_named(asked: Asked) -> None:
    with healed(asked):
        asked.pair.proxy("b").end()
        try:
            asked.until_named("/pulse", Cause.NO_PROXY_HERE)
        finally:
            asked.pair.proxy("b")
