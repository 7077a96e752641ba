"""Real rospy nodes and a real master on loopback: topics and the graph."""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.ros_names import is_of_every_node
from proxy.endpoints.core.endpoint import EndpointError, GraphChanged, MessageReceived, Role, TypeResolved
from proxy.endpoints.ros1 import Ros1Endpoint, install
from proxy.serial.channel import Channel, Qos
from tests.proxy.endpoints.ros1_net import NODE, Ear, Net, ros1_net

STRING = "std_msgs/msg/String"
STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"

TALKER = """
from std_msgs.msg import String
rospy.init_node("{node}")
publisher = rospy.Publisher("{topic}", String, queue_size=100, latch={latch})
publisher.publish("first of {node}")
print("ready")
while True:
    publisher.publish(input())
"""

LISTENER = """
from rospy import AnyMsg
rospy.init_node("{node}")
def hear(message):
    header = message._connection_header
    print(message._buff.hex(), header["callerid"], header["latching"], header["md5sum"])
rospy.Subscriber("{topic}", {type}, hear, queue_size=None)
print("ready")
rospy.spin()
"""


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    with ros1_net(tmp_path_factory.mktemp("ros")) as net:
        yield net


@pytest.fixture
def ear(net: Net) -> Ear:
    ear = net.endpoint()
    ear.wait(GraphChanged)
    return ear


@pytest.fixture(autouse=True)
def _alone(request: pytest.FixtureRequest) -> Iterator[None]:
    """Each test ends its peers and endpoints; the master stays."""
    yield
    if "net" in request.fixturenames:
        net: Net = request.getfixturevalue("net")
        net.leave()


def string(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def channel(topic: str, *, latched: bool = False, depth: int = 1, type_name: str = STRING) -> Channel:
    qos = Qos(
        depth=depth,
        reliability="reliable",
        durability="transient_local",
        deadline=(0, 0),
        lifespan=(0, 0),
        lease=(0, 0),
    )
    return Channel(
        topic,
        type_name,
        1,
        hash=STRING_MD5,
        definition="string data\n",
        definition_format="msg",
        qos=(qos,),
        latched=latched,
    )


def test_a_talker_is_heard_byte_for_byte_after_its_description(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.subscribe("/chatter", STRING, None)
    talker = net.peer(TALKER.format(node="talker", topic="/chatter", latch=True))
    ear.wait(MessageReceived)
    talker.tell("second")
    ear.wait(MessageReceived, 2)
    described = next(index for index, event in enumerate(ear.events) if isinstance(event, TypeResolved))
    heard = next(index for index, event in enumerate(ear.events) if isinstance(event, MessageReceived))
    assert described < heard
    assert ear.of(TypeResolved)[0].channel == Channel(
        "/chatter",
        STRING,
        1,
        hash=STRING_MD5,
        definition="string data\n",
        definition_format="msg",
        qos=(),
        latched=True,
        callerid="/talker",
    )
    assert [event.raw for event in ear.of(MessageReceived, handle)] == [string("first of talker"), string("second")]


def test_what_is_published_is_heard_byte_for_byte_from_our_node(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.advertise(channel("/out"))
    listener = net.peer(LISTENER.format(node="listener", topic="/out", type="AnyMsg"))
    ear.until(lambda: ear.endpoint.subscribers(handle) == 1)
    big = bytes(range(256)) * 16_384
    ear.endpoint.publish(handle, string("one"))
    ear.endpoint.publish(handle, big)
    ear.until(lambda: not ear.endpoint._rospy.link.is_behind)
    assert listener.line() == f"{string('one').hex()} /{NODE} 0 {STRING_MD5}"
    assert listener.line() == f"{big.hex()} /{NODE} 0 {STRING_MD5}"
    listener.end()
    ear.until(lambda: ear.endpoint.subscribers(handle) == 0)


def test_a_late_joiner_gets_the_kept_messages_of_a_latched_publisher_each_once(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.advertise(channel("/map", latched=True, depth=3))
    for number in range(5):
        ear.endpoint.publish(handle, string(str(number)))
    for node in ("late", "later"):
        listener = net.peer(LISTENER.format(node=node, topic="/map", type="AnyMsg"))
        assert [listener.line() for _ in range(3)] == [
            f"{string(text).hex()} /{NODE} 1 {STRING_MD5}" for text in ("2", "3", "4")
        ]
        ear.until(lambda: ear.endpoint.subscribers(handle) >= 1)
    ear.endpoint.publish(handle, string("5"))
    assert listener.line().startswith(string("5").hex())


def test_a_late_subscription_hears_the_latched_message_of_each_of_two_publishers(net: Net, ear: Ear) -> None:
    net.peer(TALKER.format(node="one", topic="/static", latch=True))
    net.peer(TALKER.format(node="two", topic="/static", latch=True))
    ear.endpoint.subscribe("/static", STRING, None)
    heard = ear.wait(MessageReceived, 2)
    assert {event.raw for event in heard} == {string("first of one"), string("first of two")}
    assert ear.of(TypeResolved)[-1].channel.callerid is None


def test_two_latched_publishers_of_ours_on_one_topic_both_reach_a_late_joiner(net: Net, ear: Ear) -> None:
    first = ear.endpoint.advertise(channel("/tf_static", latched=True))
    second = ear.endpoint.advertise(channel("/tf_static", latched=True))
    ear.endpoint.publish(first, string("a"))
    ear.endpoint.publish(second, string("b"))
    listener = net.peer(LISTENER.format(node="late", topic="/tf_static", type="AnyMsg"))
    assert {listener.line().split()[0] for _ in range(2)} == {string("a").hex(), string("b").hex()}
    ear.endpoint.close(first)
    other = net.peer(LISTENER.format(node="later", topic="/tf_static", type="AnyMsg"))
    assert other.line().split()[0] == string("b").hex()


def test_own_messages_and_those_of_another_proxy_are_not_heard(net: Net, ear: Ear) -> None:
    other = net.endpoint("gdp_proxy_ffffffffffff")
    mine = ear.endpoint.advertise(channel("/loop", latched=True))
    theirs = other.endpoint.advertise(channel("/loop", latched=True))
    ear.endpoint.publish(mine, string("mine"))
    other.endpoint.publish(theirs, string("theirs"))
    handle = ear.endpoint.subscribe("/loop", STRING, None)
    other.until(lambda: other.endpoint.subscribers(theirs) == 1)
    net.peer(TALKER.format(node="talker", topic="/loop", latch=True))
    ear.wait(MessageReceived, 1, handle)
    assert [event.raw for event in ear.of(MessageReceived)] == [string("first of talker")]
    assert ear.endpoint.subscribers(mine) == 0


def test_the_graph_shows_others_with_their_types_and_not_ourselves(net: Net, ear: Ear) -> None:
    ear.endpoint.advertise(channel("/ours"))
    net.peer(TALKER.format(node="talker", topic="/chatter", latch=False))
    listener = net.peer(LISTENER.format(node="listener", topic="/chatter", type="AnyMsg"))
    ear.wait_end("/chatter", "/listener")
    graph = {(end.role, end.name, end.type_name, end.node, end.key) for end in ear.endpoint.graph()}
    assert (Role.PUBLISHES, "/rosout", "rosgraph_msgs/msg/Log", "/talker", "/talker") in graph
    shown = {each for each in graph if not is_of_every_node("service", each[1]) and "/rosout" not in each[1]}
    assert shown == {
        (Role.PUBLISHES, "/chatter", STRING, "/talker", "/talker"),
        (Role.SUBSCRIBES, "/chatter", STRING, "/listener", "/listener"),
    }
    listener.end()
    ear.wait_end("/chatter", "/listener", gone=True)


def test_a_node_that_dies_without_a_farewell_leaves_the_graph(net: Net, ear: Ear) -> None:
    talker = net.peer(TALKER.format(node="doomed", topic="/doomed", latch=False))
    ear.wait_end("/doomed")
    talker.end(kindly=False)
    ear.wait_end("/doomed", gone=True)


def test_a_publisher_with_another_md5_is_a_fault_and_the_first_is_still_heard(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.subscribe("/mixed", STRING, None)
    talker = net.peer(TALKER.format(node="talker", topic="/mixed", latch=True))
    ear.wait(MessageReceived)
    net.peer(
        """
from std_msgs.msg import Int32
rospy.init_node("liar")
publisher = rospy.Publisher("/mixed", Int32, queue_size=1, latch=True)
publisher.publish(7)
print("ready")
rospy.spin()
"""
    )
    fault = ear.wait(EndpointError, 1, handle)[0]
    assert STRING_MD5 in fault.reason
    assert "da5909fbe378aeaf85e547e830cc1bb7" in fault.reason
    talker.tell("on")
    ear.wait(MessageReceived, 2)
    assert ear.of(MessageReceived)[-1].raw == string("on")


def test_a_definition_that_differs_from_the_installed_one_is_a_fault(ear: Ear) -> None:
    wrong = Channel("/wrong", STRING, 1, hash="0" * 32, definition="string text\n", definition_format="msg")
    handle = ear.endpoint.advertise(wrong)
    reason = ear.wait(EndpointError, 1, handle)[0].reason
    assert STRING_MD5 in reason
    assert "0" * 32 in reason


def test_a_topic_of_another_local_type_is_a_fault_until_that_is_gone(net: Net, ear: Ear) -> None:
    talker = net.peer(TALKER.format(node="talker", topic="/taken", latch=False))
    ear.wait_end("/taken")
    handle = ear.endpoint.advertise(Channel("/taken", "std_msgs/msg/Empty", 1, hash="d41d8cd98f00b204e9800998ecf8427e"))
    assert "std_msgs/String" in ear.wait(EndpointError, 1, handle)[0].reason
    talker.end()
    listener = net.peer(LISTENER.format(node="listener", topic="/taken", type="AnyMsg"))
    ear.until(lambda: ear.endpoint.subscribers(handle) == 1)
    ear.endpoint.publish(handle, b"")
    assert listener.line().split()[0] == f"/{NODE}"


def test_a_reader_of_any_type_is_no_contradiction_though_the_master_keeps_the_type_of_a_publisher_that_left(
    net: Net, ear: Ear
) -> None:
    talker = net.peer(TALKER.format(node="talker", topic="/kept", latch=False))
    strict = net.peer(
        "from std_msgs.msg import String\n" + LISTENER.format(node="strict", topic="/kept", type="String")
    )
    listener = net.peer(LISTENER.format(node="listener", topic="/kept", type="AnyMsg"))
    ear.until(lambda: {"/talker", "/strict", "/listener"} <= {entity.node for entity in ear.endpoint.graph()})
    handle = ear.endpoint.advertise(Channel("/kept", "std_msgs/msg/Empty", 1, hash="d41d8cd98f00b204e9800998ecf8427e"))
    assert "/talker" in ear.wait(EndpointError, 1, handle)[0].reason
    talker.end()
    assert "/strict" in ear.wait(EndpointError, 2, handle)[1].reason
    strict.end()
    ear.until(lambda: ear.endpoint.subscribers(handle) == 1)
    ear.endpoint.publish(handle, b"")
    assert listener.line().split()[0] == f"/{NODE}"


def test_a_type_that_is_not_installed_is_advertised_by_its_definition(net: Net, ear: Ear) -> None:
    text = (
        "Header header\nstring data\n" + "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    )
    handle = ear.endpoint.advertise(
        Channel("/odd", "far_msgs/msg/Odd", 1, hash="", definition=text, definition_format="msg")
    )
    listener = net.peer(LISTENER.format(node="listener", topic="/odd", type="AnyMsg"))
    ear.until(lambda: ear.endpoint.subscribers(handle) == 1)
    ear.endpoint.publish(handle, bytes(20))
    assert listener.line() == f"{bytes(20).hex()} /{NODE} 0 c99a9440709e4d4a9716d55b8270d5e7"


def test_an_unknown_type_is_refused_with_what_to_install(monkeypatch: pytest.MonkeyPatch, ear: Ear) -> None:
    monkeypatch.setattr("proxy.endpoints.ros1.rospy_process.ANSWER_S", 30.0)  # it imports the package
    assert ear.endpoint.channel("/x", "sensor_msgs/msg/Image").hash == "060021388200f6f0f447d0fcd9c64743"
    with pytest.raises(LocalError, match="no_msgs/msg/Such is not known here"):
        ear.endpoint.channel("/x", "no_msgs/msg/Such")
    with pytest.raises(LocalError, match="no_msgs/msg/Such"):
        ear.endpoint.advertise(Channel("/x", "no_msgs/msg/Such", 2))


def test_without_rospy_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(install, "_DEBIAN", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(LocalError, match=r"scripts/setup_ros1\.sh"):
        Ros1Endpoint("http://127.0.0.1:1", NODE)


def test_a_listener_that_stands_still_does_not_hold_up_the_others(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.advertise(channel("/busy"))
    still = net.peer(LISTENER.format(node="still", topic="/busy", type="AnyMsg"))
    awake = net.peer(LISTENER.format(node="awake", topic="/busy", type="AnyMsg"))
    ear.until(lambda: ear.endpoint.subscribers(handle) == 2)
    os.kill(still.process.pid, signal.SIGSTOP)
    for number in range(150):
        ear.endpoint.publish(handle, string(f"{number:0100000}"))
        ear.until(lambda: not ear.endpoint._rospy.link.is_behind)
        assert bytes.fromhex(awake.line().split()[0]).endswith(f"{number:04}".encode())
    os.kill(still.process.pid, signal.SIGCONT)


ROUNDABOUT = """
from std_msgs.msg import String
rospy.init_node("roundabout")
ins = [rospy.Publisher(f"/in{i}", String, queue_size=1, latch=True) for i in range(10)]
for publisher in ins:
    publisher.publish("here")
outs = [rospy.Subscriber(f"/out{i}", String) for i in range(10)]
print("ready")
rospy.spin()
"""


def test_rounds_of_subscribing_and_advertising_leave_no_descriptor_and_no_thread(net: Net, ear: Ear) -> None:
    net.peer(ROUNDABOUT)
    pid = ear.endpoint._rospy._process.pid

    def rounds(count: int) -> None:
        for _ in range(count):
            hear = [ear.endpoint.subscribe(f"/in{lane}", STRING, None) for lane in range(10)]
            tell = [ear.endpoint.advertise(channel(f"/out{lane}", latched=True)) for lane in range(10)]
            ear.wait(MessageReceived, 10)
            ear.until(lambda tell=tell: all(ear.endpoint.subscribers(handle) for handle in tell))  # type: ignore[misc]
            for handle in (*hear, *tell):
                ear.endpoint.close(handle)
            ear.events.clear()

    def held() -> tuple[int, int, int]:
        tasks = len(os.listdir(f"/proc/{pid}/task"))
        return len(os.listdir(f"/proc/{pid}/fd")), tasks, len(os.listdir("/proc/self/fd"))

    rounds(2)
    before = held()
    rounds(20)
    ear.until(lambda: all(now <= then + 3 for now, then in zip(held(), before, strict=True)))
