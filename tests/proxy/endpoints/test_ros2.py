"""Topics and the graph, with a real rclpy node in another process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import pytest

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import EndpointError, MessageReceived, Role, TypeResolved
from proxy.endpoints.ros2.qos import filled
from proxy.serial.channel import Channel
from tests.proxy.endpoints.ros2_net import CONFINED, DOMAIN, NODE, Ears, Peer, endpoint_of_ours, needs, peer_of

needs("std_msgs", "sensor_msgs")

STRING = "std_msgs/msg/String"
LATCHED = filled(None, latched=True)


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with peer_of("peer") as found:
        found.tell("!from std_msgs.msg import String, UInt8MultiArray\nfrom sensor_msgs.msg import Image")
        yield found


@pytest.fixture
def ears() -> Iterator[Ears]:
    with endpoint_of_ours() as found:
        yield found


def text(word: str) -> bytes:
    """Return a std_msgs/String in CDR, padded to four bytes like Fast CDR."""
    body = len(word.encode() + b"\0").to_bytes(4, "little") + word.encode() + b"\0"
    return b"\0\1\0\0" + body + bytes(-len(body) % 4)


def ends(ears: Ears, role: Role, name: str) -> list[str]:
    return [end.node for end in ears.endpoint.graph() if end.role is role and end.name == name]


def test_a_message_is_heard_after_its_channel_was_described(ears: Ears, peer: Peer) -> None:
    handle = ears.endpoint.subscribe("/a", STRING, None)
    peer.tell("!pa = talk(String, '/a')")
    peer.waits_for("pa.get_subscription_count()", 1)
    peer.tell("pa.publish(String(data='hello'))")
    ears.until(lambda: ears.heard(handle), "a message")
    assert ears.heard(handle) == [text("hello")]
    (described,) = ears.of(TypeResolved, handle)
    assert ears.events.index(described) < ears.events.index(ears.of(MessageReceived, handle)[0])
    channel = described.channel
    assert (channel.topic, channel.type_name, channel.ros, channel.definition) == ("/a", STRING, 2, "string data\n")
    assert [(qos.reliability, qos.durability) for qos in channel.qos] == [("reliable", "volatile")]
    peer.tell("node.destroy_publisher(pa)")


def test_an_image_goes_out_and_comes_back_byte_for_byte(ears: Ears, peer: Peer) -> None:
    peer.tell("echo(Image, '/out', '/back')")
    back = ears.endpoint.subscribe("/back", "sensor_msgs/msg/Image", None)
    out = ears.endpoint.advertise(ears.endpoint.channel("/out", "sensor_msgs/msg/Image"))
    peer.tell("!im = serialize(Image(height=480, width=640, encoding='rgb8', data=bytes(range(256)) * 3600))")
    raw = bytes.fromhex(str(peer.tell("im.hex()")))
    ears.until(lambda: ears.endpoint.subscribers(out) == 1 and ends(ears, Role.PUBLISHES, "/back"), "the echo")
    peer.waits_for("node.count_subscribers('/back')", 1)
    ears.endpoint.publish(out, raw)
    ears.until(lambda: ears.heard(back), "the image")
    assert ears.heard(back) == [raw]


def test_the_virtual_node_shows_with_its_topics_types_and_qos(ears: Ears, peer: Peer) -> None:
    channel = ears.endpoint.channel("/shown", STRING)
    ears.endpoint.advertise(replace(channel, qos=(LATCHED,), latched=True))
    ears.endpoint.subscribe("/wanted", STRING, None)
    peer.waits_for("len(node.get_publishers_info_by_topic('/shown'))", 1)
    peer.waits_for("len(node.get_subscriptions_info_by_topic('/wanted'))", 1)
    peer.waits_for("node.get_publishers_info_by_topic('/shown')[0].node_name", NODE)
    peer.tell("!i = node.get_publishers_info_by_topic('/shown')[0]")
    assert peer.tell("[i.topic_type, str(i.topic_type_hash), i.qos_profile.durability.name]") == [
        STRING,
        channel.hash,
        "TRANSIENT_LOCAL",
    ]
    # only requested events, as far as rclpy allows
    own = peer.tell(f"node.get_service_names_and_types_by_node({NODE!r}, '/')")
    assert own == []


def test_the_graph_shows_ends_that_come_and_go_and_never_our_own(ears: Ears, peer: Peer) -> None:
    ears.endpoint.subscribe("/g", STRING, None)
    ears.endpoint.advertise(ears.endpoint.channel("/g", STRING))
    peer.tell("!pg = talk(String, '/g', 'best_effort'); listen(String, '/g')")
    ears.until(lambda: ends(ears, Role.PUBLISHES, "/g") == ["/peer"], "the publisher")
    ears.until(lambda: ends(ears, Role.SUBSCRIBES, "/g") == ["/peer"], "the subscription")
    end = next(end for end in ears.endpoint.graph() if end.name == "/g" and end.role is Role.PUBLISHES)
    assert end.qos is not None
    assert (end.type_name, end.qos.reliability) == (STRING, "best_effort")
    assert end.hash == ears.endpoint.channel("/g", STRING).hash
    peer.tell("!node.destroy_publisher(pg); node.destroy_subscription(kept.pop())")
    ears.until(lambda: not ends(ears, Role.PUBLISHES, "/g") + ends(ears, Role.SUBSCRIBES, "/g"), "their end")
    assert {end.name for end in ears.endpoint.graph()} >= {"/rosout", "/parameter_events"}


def test_a_late_joiner_gets_what_a_latched_channel_kept(ears: Ears, peer: Peer) -> None:
    channel = ears.endpoint.channel("/map", STRING)
    handle = ears.endpoint.advertise(replace(channel, qos=(replace(LATCHED, depth=2),)))
    for word in ("one", "two", "three"):
        ears.endpoint.publish(handle, text(word))
    peer.tell("listen(String, '/map', 'transient_local')")
    peer.waits_for("len(heard['/map'])", 2)
    assert peer.tell("heard['/map']") == [text("two").hex(), text("three").hex()]


def test_a_late_subscription_of_ours_gets_what_a_talker_kept(ears: Ears, peer: Peer) -> None:
    peer.tell("!pl = talk(String, '/tf_static', 'transient_local', 1); pl.publish(String(data='kept'))")
    handle = ears.endpoint.subscribe("/tf_static", STRING, LATCHED)
    ears.until(lambda: ears.heard(handle), "the kept message")
    ears.until(lambda: any(event.channel.latched for event in ears.of(TypeResolved, handle)), "its description")


def test_own_messages_are_never_heard_and_those_of_others_are(ears: Ears, peer: Peer) -> None:
    out = ears.endpoint.advertise(ears.endpoint.channel("/both", STRING))
    handle = ears.endpoint.subscribe("/both", STRING, None)
    peer.tell("!pb = talk(String, '/both'); listen(String, '/both')")
    peer.waits_for("pb.get_subscription_count()", 2)
    ears.until(lambda: ears.endpoint.subscribers(out) == 1, "the listener")
    for number in range(5):
        ears.endpoint.publish(out, text(f"ours {number}"))
    peer.waits_for("len(heard['/both'])", 5)
    peer.tell("pb.publish(String(data='theirs'))")
    ears.until(lambda: ears.heard(handle), "theirs")
    ears.for_s(0.3)
    assert ears.heard(handle) == [text("theirs")]


def test_own_kept_messages_are_not_heard_by_a_late_subscription(ears: Ears) -> None:
    out = ears.endpoint.advertise(replace(ears.endpoint.channel("/kept", STRING), qos=(LATCHED,)))
    ears.endpoint.publish(out, text("ours"))
    handle = ears.endpoint.subscribe("/kept", STRING, LATCHED)
    ears.for_s(0.5)
    assert ears.heard(handle) == []


def test_a_qos_that_cannot_match_is_a_fault_that_says_why(ears: Ears, peer: Peer) -> None:
    peer.tell("!pq = talk(String, '/q', 'best_effort')")
    handle = ears.endpoint.subscribe("/q", STRING, None)
    ears.until(lambda: ears.of(EndpointError, handle), "the fault")
    assert "reliability: best effort offered, reliable requested" in ears.of(EndpointError, handle)[0].reason
    assert "/peer" in ears.of(EndpointError, handle)[0].reason


def test_a_topic_of_another_type_is_a_fault(ears: Ears, peer: Peer) -> None:
    peer.tell("!pt = talk(String, '/typed')")
    handle = ears.endpoint.subscribe("/typed", "sensor_msgs/msg/Image", None)
    ears.until(lambda: ears.of(EndpointError, handle), "the fault")
    assert f"another type, {STRING}" in ears.of(EndpointError, handle)[0].reason


def test_after_close_no_event_names_the_handle(ears: Ears, peer: Peer) -> None:
    handle = ears.endpoint.subscribe("/c", STRING, None)
    peer.tell("!pc = talk(String, '/c')")
    peer.waits_for("pc.get_subscription_count()", 1)
    peer.tell("![pc.publish(String(data=str(i))) for i in range(10)]")
    peer.waits_for("pc.wait_for_all_acked()", True)
    ears.endpoint.close(handle)
    ears.for_s(0.3)
    assert not ears.heard(handle)
    peer.waits_for("pc.get_subscription_count()", 0)


def test_an_unknown_type_says_what_to_install(ears: Ears) -> None:
    with pytest.raises(LocalError, match="install the package no_such_msgs"):
        ears.endpoint.subscribe("/x", "no_such_msgs/msg/Thing", None)
    with pytest.raises(LocalError, match="not the name of a ROS 2 interface"):
        ears.endpoint.channel("/x", "String")


def test_another_definition_or_another_ros_is_refused(ears: Ears) -> None:
    channel = ears.endpoint.channel("/x", STRING)
    with pytest.raises(LocalError, match="another definition"):
        ears.endpoint.advertise(replace(channel, hash="", definition="string data\nint32 more\n"))
    with pytest.raises(LocalError, match="ROS 1"):
        ears.endpoint.advertise(Channel("/x", STRING, 1))
    with pytest.raises(LocalError, match="cannot be subscribed to"):
        ears.endpoint.subscribe("/not a name", STRING, None)


def test_many_rounds_leave_no_descriptor_and_no_thread(ears: Ears) -> None:
    def rounds(count: int) -> None:
        for _ in range(count):
            handles = [ears.endpoint.subscribe("/r", STRING, None)]
            handles.append(ears.endpoint.advertise(ears.endpoint.channel("/r", STRING)))
            for handle in handles:
                ears.endpoint.close(handle)
            ears.endpoint.poll_events()

    rounds(20)
    before = len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))
    resident = _resident_kb()
    rounds(200)
    assert (len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))) == before
    assert _resident_kb() - resident < 8_000


def _resident_kb() -> int:
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))


def test_an_endpoint_that_was_shut_leaves_nothing() -> None:
    with endpoint_of_ours():
        pass
    before = len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))
    for _ in range(3):
        with endpoint_of_ours() as ears:
            ears.endpoint.subscribe("/s", STRING, None)
            ears.endpoint.serve(ears.endpoint.service("/s", "std_srvs/srv/SetBool"))
    assert (len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))) == before


@pytest.mark.parametrize(
    ("environment", "hides", "said"),
    [
        ({}, True, "rclpy cannot be imported: source your ROS 2"),
        ({"RMW_IMPLEMENTATION": "rmw_none_cpp"}, False, "rmw_none_cpp, but this machine has only rmw_"),
    ],
)
def test_where_ros_2_is_absent_one_sentence_says_what_to_do(
    environment: dict[str, str], hides: bool, said: str
) -> None:
    script = (
        "import sys\n"
        f"if {hides}: sys.modules['rclpy'] = None\n"
        "from gdp.errors import LocalError\n"
        "from proxy.endpoints.ros2 import Ros2Endpoint\n"
        "try: Ros2Endpoint(%d, 'gdp_proxy_x')\n" % DOMAIN + "except LocalError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, **CONFINED, **environment},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert said in done.stdout, done.stderr
    assert len(done.stdout.splitlines()) == 1
