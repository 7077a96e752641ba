"""Faults with real nodes: one warning with the local name where the fault is, and all other flows continue."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lab.process import until
from netns_tests.live_pair import Crossing, Pair, Proxy, pair_of
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs", "sensor_msgs", "geometry_msgs", "std_srvs", "diagnostic_msgs")
pytestmark = pytest.mark.netns

STRING, SET_BOOL, IMAGE = "std_msgs/msg/String", "std_srvs/srv/SetBool", "sensor_msgs/msg/Image"
MAX_BYTES = 1_000
CROSSINGS = (
    Crossing("/pulse", STRING, "a", "b one"),
    Crossing("/diagnosis", "diagnostic_msgs/msg/DiagnosticArray", "a", "b"),
    Crossing("/corner", "geometry_msgs/msg/Point32", "one", "a"),
    Crossing("/long", STRING, "a", "b", options={"max_bytes": MAX_BYTES}),
    Crossing("/film", IMAGE, "a", "b", options={"encoding": "cdr"}),
    Crossing("/deadline", STRING, "a", "b"),
    Crossing("/gate", SET_BOOL, "a", "b one", "service", {"timeout_s": 2}),
    Crossing("/lamp", SET_BOOL, "one", "a", "service", {"timeout_s": 2}),
    Crossing("/from_one", STRING, "one", "a"),
)
_ROS2 = """
from std_msgs.msg import String
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point32
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
def read(kind, topic, **more):
    heard[topic] = []
    qos = QoSProfile(depth=100, **more)
    kept.append(node.create_subscription(kind, topic, lambda m: heard[topic].append(values(m)), qos))
def ask(client, request, answers=None):
    answers = [] if answers is None else answers
    client.call_async(request).add_done_callback(lambda future: answers.append(values(future.result())))
    return answers
"""
_SERVER = """
asked = []
async def answer(request, response):
    asked.append(request.data)
    if not request.data: await rclpy.Future()
    response.success, response.message = True, 'done'
    return response
kept.append(node.create_service(SetBool, '/gate', answer))
"""


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with pair_of(*CROSSINGS, hidden={"b": "diagnostic_msgs"}) as made:
        yield made


def node_of(pair: Pair, graph: str, name: str = "") -> Peer:
    """Return a node with the helpers of the tests."""
    node = pair.node(graph, name)
    node.tell("!from std_srvs.srv import *; from std_msgs.msg import String" if graph == "one" else "!" + _ROS2)
    return node


@pytest.fixture
def a(pair: Pair) -> Peer:
    node = node_of(pair, "a")
    node.tell("!pulse = talk(String, '/pulse') if 'pulse' not in globals() else pulse")
    return node


@pytest.fixture
def b(pair: Pair) -> Peer:
    node = node_of(pair, "b")
    node.tell("read(String, '/pulse')")
    return node


def flows(a: Peer, b: Peer) -> None:
    """Wait until a message published from now on is received."""
    before = b.tell("len(heard['/pulse'])")
    until(lambda: a.tell("pulse.publish(String())") or b.tell("len(heard['/pulse'])") != before, "the rest")


def tells(proxy: Proxy, name: str, fault: str) -> str:
    """Wait until a proxy has logged a fault once and counted it in its metrics; return the detail."""
    until(lambda: proxy.warnings(name), f"{fault} of {name}")
    warnings = proxy.warnings(name)
    assert [warning.partition(": ")[0] for warning in warnings] == [fault], warnings
    assert proxy.faults(fault) > 0
    return warnings[0].removeprefix(fault + ": ")


@pytest.mark.nightly
def test_a_type_that_the_far_machine_has_not(pair: Pair, a: Peer, b: Peer) -> None:
    a.tell("!diagnosis = talk(DiagnosticArray, '/diagnosis')")
    b.tell("read(DiagnosticArray, '/diagnosis')")
    a.waits_for("diagnosis.get_subscription_count()", 1)
    until(lambda: a.tell("diagnosis.publish(DiagnosticArray())") or pair.proxy("b").warnings("/diagnosis"), "a warning")
    assert "install the package diagnostic_msgs" in tells(pair.proxy("b"), "/diagnosis", "unknown-type")
    assert pair.proxy("a").warnings("/diagnosis") == []
    flows(a, b)


@pytest.mark.nightly
def test_definitions_that_differ(pair: Pair, a: Peer, b: Peer) -> None:
    one = node_of(pair, "one")
    a.tell("read(Point32, '/corner')")
    one.tell(
        "!from genpy.dynamic import generate_dynamic\n"
        "text = chr(10).join(['float32 x', 'float32 y', 'float32 w'])\n"
        "Odd = generate_dynamic('geometry_msgs/Point32', text)['geometry_msgs/Point32']\n"
        "corner = talk(Odd, '/corner')"
    )
    until(lambda: one.tell("corner.publish(Odd(1, 2, 3))") or pair.proxy("a").warnings("/corner"), "a warning")
    assert tells(pair.proxy("a"), "/corner", "other-type").endswith("z: called w there")
    assert pair.proxy("one").warnings("/corner") == []
    assert a.tell("heard['/corner']") == []
    flows(a, b)


@pytest.mark.nightly
def test_a_message_above_the_limit(pair: Pair, a: Peer, b: Peer) -> None:
    b.tell("read(String, '/long')")
    a.tell("!long, m = talk(String, '/long'), String(data='short')")
    until(lambda: a.tell("long.publish(m)") or b.tell("len(heard['/long'])"), "/long")
    for length in (2 * MAX_BYTES, 3 * MAX_BYTES):
        a.tell(f"long.publish(String(data='x' * {length}))")
    assert f"max_bytes is {MAX_BYTES}" in tells(pair.proxy("a"), "/long", "too-large")
    until(lambda: pair.proxy("a").faults("too-large") == 2, "both counted")
    flows(a, b)
    assert b.tell("{text for text, in heard['/long']} == {'short'}") is True


@pytest.mark.nightly
def test_a_reader_that_wants_what_no_network_can_promise(pair: Pair, a: Peer, b: Peer) -> None:
    a.tell("!dead = talk(String, '/deadline')")
    b.tell("read(String, '/deadline', deadline=Duration(seconds=1))")
    assert "it requests a deadline" in tells(pair.proxy("b"), "/deadline", "qos")
    flows(a, b)


@pytest.mark.nightly
def test_a_publisher_that_is_faster_than_the_path(pair: Pair, a: Peer, b: Peer) -> None:
    b.tell("read(Image, '/film')")
    a.tell("!film = talk(Image, '/film'); picture = Image(height=100, width=1000, step=3000, data=bytes(300_000))")
    until(lambda: a.tell("film.publish(picture)") or b.tell("len(heard['/film'])"), "/film")
    pair.shape("20mbit")
    try:
        until(lambda: a.tell("film.publish(picture)") or pair.proxy("a").faults("too-fast"), "too fast")
        flows(a, b)
    finally:
        pair.shape("")
    assert "faster than readers" in tells(pair.proxy("a"), "/film", "too-fast")
    before = b.tell("len(heard['/film'])")
    until(lambda: a.tell("film.publish(picture)") or b.tell("len(heard['/film'])") != before, "/film on a free path")


def failures(proxy: Proxy) -> int:
    """Return how many calls of local clients failed, on either side's timeout."""
    return sum(map(proxy.faults, ("refused", "timed-out", "no-server")))


@pytest.mark.parametrize("kill", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_a_server_that_leaves_or_dies_while_it_is_asked(pair: Pair, a: Peer, b: Peer, kill: bool) -> None:
    server = node_of(pair, "a", f"server_{kill}".lower())
    server.tell("!" + _SERVER)
    b.tell("!gate = node.create_client(SetBool, '/gate')")
    b.waits_for("gate.wait_for_service(0.1)", True)
    proxy = pair.proxy("b")
    before = failures(proxy)
    b.tell("!failed = ask(gate, SetBool.Request(data=False))")
    server.waits_for("asked", [False])
    server.end(kill=kill)
    b.waits_for("len(failed)", 1)
    assert b.tell("failed[0][0]") is False
    assert str(b.tell("failed[0][1]")).endswith(" is gone") != kill  # a killed node stays in the graph for a while
    assert failures(proxy) > before
    assert proxy.warnings("/gate")
    again = node_of(pair, "a", f"again_{kill}".lower())
    again.tell("!" + _SERVER)
    until(lambda: b.tell("!ask(gate, SetBool.Request(data=True))") or again.tell("len(asked)"), "a new server")
    b.tell("!lit = ask(gate, SetBool.Request(data=True))")
    b.waits_for("lit", [[True, "done"]])
    again.end()
    flows(a, b)


@pytest.mark.nightly
def test_a_ros_1_server_that_dies_while_it_is_asked(pair: Pair, a: Peer, b: Peer) -> None:
    server = node_of(pair, "one", "server")
    server.tell("!import time; asked = []; serve(SetBool, '/lamp', lambda r: asked.append(1) or time.sleep(30))")
    a.tell("!lamp = node.create_client(SetBool, '/lamp')")
    a.waits_for("lamp.wait_for_service(0.1)", True)
    a.tell("!failed = ask(lamp, SetBool.Request(data=False))")
    server.waits_for("len(asked)", 1)
    server.end(kill=True)
    a.waits_for("len(failed)", 1)
    assert "unable to receive data from sender" in str(a.tell("failed"))
    assert "unable to receive data from sender" in tells(pair.proxy("one"), "/lamp", "refused")
    again = node_of(pair, "one", "again")
    again.tell("!serve(SetBool, '/lamp', lambda request: SetBoolResponse(True, 'done'))")
    a.tell("!lit = []")
    until(lambda: a.tell("!ask(lamp, SetBool.Request(data=True), lit)") or a.tell("[True, 'done'] in lit"), "a new one")
    flows(a, b)


def test_a_master_that_restarts(pair: Pair, a: Peer, b: Peer) -> None:
    one = node_of(pair, "one")
    one.tell("listen(String, '/pulse')")
    until(lambda: a.tell("pulse.publish(String())") or one.tell("len(heard['/pulse'])"), "/pulse at ROS 1")
    pair.stop_master()
    assert "ROS 1 master at http://127.0.0.1:11311" in tells(pair.proxy("one"), "/pulse", "no-graph")
    flows(a, b)
    pair.start_master()
    late = node_of(pair, "one", "late")
    late.tell("listen(String, '/pulse')")
    until(lambda: a.tell("pulse.publish(String())") or late.tell("len(heard['/pulse'])"), "/pulse after the restart")


@pytest.mark.nightly
def test_what_crossed_still_does_when_three_leases_are_over(pair: Pair, a: Peer, b: Peer) -> None:
    pair.outlive()
    flows(a, b)
