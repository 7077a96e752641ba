"""Real nodes on two machines: ROS 1, ROS 2 and Cyclone DDS, topics, services and actions, across the overlay."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator, Mapping

import pytest

from lab.machine import gdp as gdp_command
from lab.process import until
from netns_tests.live_pair import Crossing, Pair, pair_of
from tests.proxy.endpoints.ros2_net import Peer, needs

needs("std_msgs", "nav_msgs", "sensor_msgs", "geometry_msgs", "std_srvs", "test_msgs")
pytestmark = pytest.mark.netns

STRING, SET_BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
TIMEOUT_S = 1.0
STOP = -1.0
CONTROL = {"silence_s": 2.0, "stop": {"linear": {"x": STOP}}}
PREFIX = "robot1"
CROSSINGS = (
    Crossing("/odom", "nav_msgs/msg/Odometry", "a", "one"),
    Crossing("/image", "sensor_msgs/msg/Image", "one", "a"),
    Crossing("/lamp", SET_BOOL, "one", "a", "service"),
    Crossing("/gate", SET_BOOL, "a", "one", "service", {"timeout_s": TIMEOUT_S}),
    Crossing("/many", SET_BOOL, "a", "b", "service"),
    Crossing("/chat", STRING, "a", "dds"),
    Crossing("/chat_back", STRING, "dds", "a", options={"encoding": "cdr"}),
    Crossing("/fold", "test_msgs/action/Fibonacci", "a", "b", "action", {"timeout_s": TIMEOUT_S}),
    Crossing("/map", STRING, "a", "b"),
    Crossing("/statics", "geometry_msgs/msg/TransformStamped", "a", "b"),
    Crossing("/twice", STRING, "a", "b twin"),
    Crossing("/twice_back", STRING, "b twin", "a"),
    Crossing("/leaving", SET_BOOL, "a", "b", "service"),
    Crossing("/prefixed", STRING, "a", "b", options={"prefix": PREFIX}),
    *(Crossing(f"/churn_{at}", STRING, "a", "b") for at in range(10)),
    Crossing("/cmd_vel", "geometry_msgs/msg/Twist", "b dds", "a", options={"control": CONTROL}),
)
_ROS2 = """
if 'reads' not in globals(): reads, talks = {}, {}
from std_msgs.msg import String
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image
from geometry_msgs.msg import TransformStamped, Twist, Vector3
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.qos import DurabilityPolicy, QoSProfile
def read(kind, topic, depth=10, durability='volatile'):
    if topic in reads: node.destroy_subscription(reads.pop(topic))
    found = heard[topic] = []
    qos = QoSProfile(depth=depth, durability=DurabilityPolicy[durability.upper()])
    reads[topic] = node.create_subscription(kind, topic, lambda m: found.append(values(m)), qos)
def say(topic, *texts):
    if topic not in talks: talks[topic] = node.create_publisher(String, topic, 1000)
    for text in texts: talks[topic].publish(String(data=str(text)))
def ask(client, request):
    answers = []
    client.call_async(request).add_done_callback(lambda future: answers.append(values(future.result())))
    return answers
"""
_ODOMETRY = """
m = Odometry(child_frame_id='base')
m.header.frame_id, m.header.stamp.{sec}, m.header.stamp.{nano} = 'odöm', 12, 34
m.pose.pose.position.x, m.twist.twist.angular.z = 0.1, -1e-300
m.pose.covariance[35] = float('inf')
"""


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with pair_of(*CROSSINGS) as made:
        yield made


def node_of(pair: Pair, graph: str, name: str = "") -> Peer:
    """Return a ROS 2 node with the helpers of the tests."""
    node = pair.node(graph, name)
    node.tell("!" + _ROS2)
    return node


@pytest.fixture
def a(pair: Pair) -> Peer:
    return node_of(pair, "a")


@pytest.fixture
def b(pair: Pair) -> Peer:
    return node_of(pair, "b")


@pytest.fixture
def one(pair: Pair) -> Peer:
    node = pair.node("one")
    node.tell("!from std_srvs.srv import *; from nav_msgs.msg import Odometry; from sensor_msgs.msg import Image")
    return node


def test_a_ros_1_node_hears_what_a_ros_2_node_says_field_by_field(a: Peer, one: Peer) -> None:
    one.tell("listen(Odometry, '/odom')")
    a.tell("!odom = talk(Odometry, '/odom')" + _ODOMETRY.format(sec="sec", nano="nanosec"))
    until(lambda: a.tell("odom.publish(m)") or one.tell("len(heard['/odom'])"), "/odom at ROS 1")
    assert one.tell("heard['/odom'][0]") == a.tell("values(m)")


def test_a_ros_2_node_hears_what_a_ros_1_node_says_field_by_field(a: Peer, one: Peer) -> None:
    a.tell("read(Image, '/image')")
    one.tell("!m = Image(height=2, width=2, encoding='rgb8', step=6, data=bytes(range(12)))")
    one.tell("!m.header.frame_id = 'lens'; m.header.stamp.nsecs = 7; image = talk(Image, '/image')")
    until(lambda: one.tell("image.publish(m)") or a.tell("len(heard['/image'])"), "/image at ROS 2")
    assert a.tell("heard['/image'][0]") == one.tell("values(m)")


def test_a_ros_1_server_serves_a_ros_2_client(a: Peer, one: Peer) -> None:
    one.tell("!serve(SetBool, '/lamp', lambda request: SetBoolResponse(request.data, 'lämp'))")
    a.tell("!lamp = node.create_client(SetBool, '/lamp')")
    a.waits_for("lamp.wait_for_service(0.1)", True)
    a.tell("!lit = ask(lamp, SetBool.Request(data=True))")
    a.waits_for("lit", [[True, "lämp"]])


def test_a_ros_2_server_serves_a_ros_1_client_or_sends_it_the_reason(a: Peer, one: Peer, pair: Pair) -> None:
    a.tell(
        "!def opened(request, response):\n"
        " if not request.data: __import__('time').sleep(2.5)\n"
        " response.success, response.message = request.data, 'open'\n"
        " return response\n"
        "gate = node.create_service(SetBool, '/gate', opened)"
    )
    assert one.tell("call(SetBool, '/gate', True)") == [True, "open"]
    refused = str(one.tell("call(SetBool, '/gate', False)"))
    assert refused.startswith("ServiceException")
    assert "no answer within 1 s" in refused
    assert pair.proxy("one").warnings("/gate") == ["timed-out: no answer within 1 s"]
    until(lambda: one.tell("call(SetBool, '/gate', True)") == [True, "open"], "the next call")


@pytest.mark.nightly
def test_no_queue_of_a_node_loses_a_call_after_a_stall(a: Peer, b: Peer, pair: Pair) -> None:
    a.tell(
        "!asked = []\n"
        "def switched(request, response):\n"
        " asked.append(request.data)\n"
        " __import__('time').sleep(0.02)\n"
        " response.success = request.data\n"
        " return response\n"
        "many = node.create_service(SetBool, '/many', switched)"
    )
    b.tell("!many = node.create_client(SetBool, '/many')")
    b.waits_for("many.wait_for_service(0.1)", True)
    calls = "!answers = [ask(many, SetBool.Request(data=at % 2 == 0)) for at in range(40)]"
    right = [at % 2 == 0 for at in range(40)]
    os.kill(pair.proxy("a").pid, signal.SIGSTOP)
    b.tell(calls)
    os.kill(pair.proxy("a").pid, signal.SIGCONT)  # all requests arrive, faster than the node answers them
    b.waits_for("sum(map(len, answers))", 40)
    assert b.tell("[each[0][0] for each in answers]") == right

    a.tell("!asked.clear()")
    b.tell(calls)
    a.waits_for("len(asked) >= 20", True)
    os.kill(pair.proxy("b").pid, signal.SIGSTOP)
    a.waits_for("len(asked)", 40)
    os.kill(pair.proxy("b").pid, signal.SIGCONT)  # half of the answers arrive
    b.waits_for("sum(map(len, answers))", 40)
    assert b.tell("[each[0][0] for each in answers]") == right


def test_a_machine_without_ros_2_speaks_with_one_that_has_it(a: Peer, pair: Pair) -> None:
    far = node_of(pair, "dds")
    for here, there, topic in ((a, far, "/chat"), (far, a, "/chat_back")):
        there.tell(f"listen(String, '{topic}')")
        here.tell(f"!chat, m = talk(String, '{topic}'), String(data='grüezi')")
        until(lambda: here.tell("chat.publish(m)") or there.tell(f"len(heard['{topic}'])"), topic)  # noqa: B023
        assert there.tell(f"heard['{topic}'][0]") == here.tell("serialize(m).hex()")


def test_an_action_lasts_longer_than_any_timeout_and_each_client_has_its_own_goal(a: Peer, b: Peer, pair: Pair) -> None:
    other = node_of(pair, "b", "other")
    a.tell(
        "!goals = []\n"
        "def folded(goal):\n"
        " goal.succeed()\n"
        " return Fibonacci.Result(sequence=[goal.request.order])\n"
        "def stopped(goal):\n"
        " goal.canceled()\n"
        " return Fibonacci.Result(sequence=[-1])\n"
        "fold = ActionServer(node, Fibonacci, '/fold', folded, handle_accepted_callback=goals.append,"
        " cancel_callback=lambda goal: CancelResponse.ACCEPT)"
    )
    for order, client in ((5, b), (6, other)):
        client.tell(
            "!news, results, mine, client = [], [], [], ActionClient(node, Fibonacci, '/fold')\n"
            "def ended(future): results.append([future.result().status, list(future.result().result.sequence)])\n"
            "def begun(future):\n"
            " mine.append(future.result())\n"
            " mine[0].get_result_async().add_done_callback(ended)\n"
            "def hears(message): news.append(list(message.feedback.sequence))"
        )
        client.waits_for("client.wait_for_server(0.1)", True)
        client.tell(f"!client.send_goal_async(Fibonacci.Goal(order={order}), hears).add_done_callback(begun)")
        a.waits_for("goals[-1].request.order if goals else 0", order)
        client.waits_for("len(mine)", 1)
    for at, client in ((0, b), (1, other)):
        a.tell(f"!goals[{at}].publish_feedback(Fibonacci.Feedback(sequence=[{at}]))")
        client.waits_for("news", [[at]])
    other.tell("!mine[0].cancel_goal_async()")
    a.waits_for("goals[1].is_cancel_requested", True)
    a.tell("!goals[1].execute(stopped)")
    other.waits_for("results", [[5, [-1]]])  # STATUS_CANCELED
    time.sleep(2 * TIMEOUT_S)  # longer than the timeout, on purpose
    a.tell("!goals[0].execute(folded)")
    b.waits_for("results", [[4, [5]]])  # STATUS_SUCCEEDED
    assert pair.proxy("b").warnings("/fold") == []


def test_a_late_joiner_gets_what_was_latched(a: Peer, b: Peer) -> None:
    a.tell("!map = talk(String, '/map', 'transient_local', 1)")
    a.tell("!map.publish(String(data='old')); map.publish(String(data='new'))")
    b.tell("read(String, '/map', 1, 'transient_local')")
    b.waits_for("heard['/map']", [["new"]])


@pytest.mark.nightly
def test_what_two_nodes_latched_in_one_topic_reaches_a_late_joiner(a: Peer, b: Peer, pair: Pair) -> None:
    other = node_of(pair, "a", "other")
    for node, frame in ((a, "arm"), (other, "base")):
        node.tell("!statics = talk(TransformStamped, '/statics', 'transient_local', 1)")
        node.tell(f"!statics.publish(TransformStamped(child_frame_id='{frame}'))")
    for _ in ("the first", "one that comes later still"):
        b.tell("read(TransformStamped, '/statics', 100, 'transient_local')")
        b.waits_for("sorted({m[1] for m in heard['/statics']})", ["arm", "base"])


def said(node: Peer) -> list[int]:
    """Return the numbers that were received."""
    numbers = node.tell("[int(text) for text, in heard['/twice']]")
    assert isinstance(numbers, list)
    return numbers


def say(node: Peer, first: int, end: int) -> object:
    """Publish these numbers; return None."""
    return node.tell(f"say('/twice', *range({first}, {end}))")


@pytest.mark.nightly
def test_of_two_proxies_in_one_graph_one_carries_and_the_other_takes_over(a: Peer, b: Peer, pair: Pair) -> None:
    proxies = [pair.proxy("b"), pair.proxy("twin")]
    until(lambda: any(proxy.faults("other-bridge") for proxy in proxies), "one gives way")
    b.tell("read(String, '/twice', 1_000)")
    until(lambda: say(a, 0, 1) or said(b), "/twice")
    say(a, 1, 101)
    until(lambda: said(b)[-1:] == [100], "all of /twice")
    assert [number for number in said(b) if number] == list(range(1, 101))
    carrier = b.tell("[i.node_name for i in node.get_publishers_info_by_topic('/twice')]")
    first = next(proxy for proxy in proxies if carrier == [proxy.node_name])
    first.end()  # a killed node stays in the graph for the lease of its DDS participant, 20 s
    try:
        until(lambda: say(a, 101, 102) or 101 in said(b), "/twice by the other")
        say(a, 102, 201)
        until(lambda: said(b)[-1:] == [200], "the rest of /twice")
        assert [number for number in said(b) if number > 101] == list(range(102, 201))
    finally:
        first.start()
    b.waits_for("len(node.get_publishers_info_by_topic('/twice'))", 1)


def test_flows_resume_when_a_killed_proxy_is_started_again(a: Peer, b: Peer, pair: Pair) -> None:
    proxy = pair.proxy("a")
    b.tell("read(String, '/twice', 1_000)")
    until(lambda: say(a, 0, 1) or said(b), "/twice")
    proxy.end(signal.SIGKILL)
    proxy.start()
    until(lambda: say(a, 1, 2) or 1 in said(b), "/twice after the restart")
    say(a, 2, 102)
    until(lambda: said(b)[-1:] == [101], "all of /twice")
    assert [number for number in said(b) if number > 1] == list(range(2, 102))


def control(pair: Pair, label: str, *words: str) -> str:
    """Return who holds the control of ``/cmd_vel``, after a command through a proxy."""
    verb, *others = words
    printed = gdp_command("control", verb, "/cmd_vel", *others, "--node", pair.identity(label), "--json")
    (reader,) = json.loads(printed)["readers"]
    return str(reader["holder"])


def writers(pair: Pair) -> list[object]:
    """Return the publishers of ``/cmd_vel`` that proxy "a" knows."""
    rows = json.loads(gdp_command("show", "peers", "--node", pair.identity("a"), "--json"))["rows"]
    return [row["peer"] for row in rows if (row["local"], row["is"]) == ("/cmd_vel", "writer")]


def test_one_of_two_publishers_drives_and_its_silence_is_answered_by_a_stop(a: Peer, b: Peer, pair: Pair) -> None:
    other = node_of(pair, "dds")
    a.tell("read(Twist, '/cmd_vel')")
    for node, speed in ((b, 1.0), (other, 2.0)):
        node.tell(f"!stick, m = node.create_publisher(Twist, '/cmd_vel', 10), Twist(linear=Vector3(x={speed}))")
        node.tell("!timer = node.create_timer(0.05, lambda: stick.publish(m))")
    speeds = "[each[0][0] for each in heard['/cmd_vel']]"
    until(lambda: len(writers(pair)) == 2, "both publishers are known to the robot's proxy")
    refused = 'gdp_drops_total{reason="not-in-control"}'
    until(lambda: pair.proxy("a").metric(refused) > 0, "messages of a publisher without control")
    assert control(pair, "b", "take") == "proxy-b"
    a.waits_for(f"{speeds}[-1:]", [1.0])
    assert set(a.tell(speeds)) <= {1.0, STOP}  # type: ignore[call-overload]
    assert control(pair, "dds", "take", "--force") == "proxy-dds"
    a.waits_for(f"{speeds}[-1:]", [2.0])
    other.tell("!timer.cancel()")
    a.waits_for(f"{speeds}[-1:]", [STOP])
    b.tell("!timer.cancel()")
    assert control(pair, "a", "show") == "proxy-dds"
    assert control(pair, "a", "give") == ""


@pytest.mark.nightly
def test_what_comes_and_goes_leaves_memory_and_descriptors_where_they_were(a: Peer, b: Peer, pair: Pair) -> None:
    proxies = [pair.proxy("a"), pair.proxy("b")]
    for at in range(10):
        b.tell(f"read(String, '/churn_{at}')")

    def rounds(count: int) -> None:
        a.tell(
            "!import time\n"
            f"for _ in range({count}):\n"
            " churn = [node.create_publisher(String, f'/churn_{at}', 10) for at in range(10)]\n"
            " while not all(each.get_subscription_count() for each in churn): time.sleep(0.001)\n"
            " for each in churn: node.destroy_publisher(each)\n"
            " while any(node.count_subscribers(f'/churn_{at}') for at in range(10)): time.sleep(0.001)"
        )

    rounds(20)  # caches and the heap fill
    before = [(proxy.descriptors(), proxy.memory_kib()) for proxy in proxies]
    rounds(30)
    after = [(proxy.descriptors(), proxy.memory_kib()) for proxy in proxies]
    for (descriptors, memory_kib), (more_descriptors, more_kib) in zip(before, after, strict=True):
        assert abs(more_descriptors - descriptors) <= 4
        assert more_kib - memory_kib <= 4_096


def gdp(pair: Pair, label: str, *words: str) -> list[Mapping[str, object]]:
    """Return what a command about a running proxy prints as JSON, a line each."""
    printed = gdp_command(*words, "--config", pair.folder / f"proxy-{label}.yaml", "--json")
    return [json.loads(line) for line in printed.splitlines()]


def test_a_prefixed_topic_crosses_is_watched_and_is_denied_by_command(a: Peer, b: Peer, pair: Pair) -> None:
    b.tell("read(String, '/prefixed')")

    def arrives() -> object:
        return a.tell("say('/prefixed', 'hello')") or b.tell("len(heard['/prefixed'])")

    until(arrives, "/prefixed at the station")
    (event,) = gdp(pair, "b", "watch", f"/{PREFIX}/*", "--count", "1")
    assert (event["event"], event["role"], event["name"]) == ("appears", "publisher", f"/{PREFIX}/prefixed")
    assert gdp(pair, "a", "rule", "add", "deny", "/prefixed")[0]["applied"] == "now"
    until(lambda: not gdp(pair, "b", "watch", f"/{PREFIX}/*", "--for", "0"), "the publisher goes")
    assert gdp(pair, "a", "rule", "remove", "deny", "/prefixed")[0]["applied"] == "now"
    b.tell("!heard['/prefixed'].clear()")
    until(arrives, "/prefixed at the station again")


def test_a_proxy_that_leaves_answers_what_is_under_way_and_ends(a: Peer, b: Peer, pair: Pair) -> None:
    a.tell(
        "!asked = []\n"
        "def answered(request, response):\n"
        " asked.append(1); __import__('time').sleep(1); response.success, response.message = True, 'done'\n"
        " return response\n"
        "leaving = node.create_service(SetBool, '/leaving', answered)"
    )
    b.tell("!leaving = node.create_client(SetBool, '/leaving')")
    b.waits_for("leaving.service_is_ready()", True)
    b.tell("!left = ask(leaving, SetBool.Request(data=True))")
    a.waits_for("len(asked)", 1)
    pair.proxy("a").end(signal.SIGUSR1)  # and wait for its end
    b.waits_for("left", [[True, "done"]])
    assert "leaving" in pair.proxy("a").said


def test_what_crossed_still_does_when_three_leases_are_over(a: Peer, b: Peer, pair: Pair) -> None:
    b.tell("read(String, '/churn_0')")
    until(lambda: a.tell("say('/churn_0', 'now')") or b.tell("len(heard['/churn_0'])"), "/churn_0")
    pair.outlive()
    until(lambda: a.tell("say('/churn_0', 'later')") or b.tell("['later'] in heard['/churn_0']"), "three leases later")
