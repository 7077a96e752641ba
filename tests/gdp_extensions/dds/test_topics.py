"""Topics of endpoint ``dds``, with a node of rclpy (Fast DDS) as the peer."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence

import pytest

pytest.importorskip("cyclonedds", reason="Cyclone DDS's Python binding is not installed")
pytest.importorskip("rclpy", reason="rclpy is not installed")

from gdp.errors import LocalError
from gdp_extensions.dds.endpoint import DdsEndpoint
from proxy.endpoints.core.endpoint import (
    EndpointError,
    Event,
    GraphChanged,
    MessageReceived,
    RequestReceived,
    Role,
    TypeResolved,
)
from proxy.endpoints.core.qos import default, unmatched
from proxy.serial.channel import Channel, Service
from tests.gdp_extensions.dds.peers import CYCLONE, Ears, Peer, digest, peer

STRING = "std_msgs/msg/String"
HELLO = b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00\x00\x00"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


@pytest.fixture(scope="module")
def domain() -> int:
    return 100 + os.getpid() % 100


@pytest.fixture(scope="module")
def ears(domain: int) -> Iterator[Ears]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", CYCLONE)
        endpoint = DdsEndpoint(domain, "gdp_proxy_0123456789ab")
    yield Ears(endpoint)
    endpoint.shut_down()


@pytest.fixture(scope="module")
def robot(domain: int) -> Iterator[Peer]:
    with peer("rclpy", domain) as found:
        yield found


def heard(events: Sequence[Event]) -> list[bytes]:
    return [event.raw for event in events if isinstance(event, MessageReceived)]


def test_a_node_of_rclpy_is_seen_with_its_type_hash_and_qos(ears: Ears, robot: Peer) -> None:
    robot.tell("advertise", topic="/chat", type=STRING, latched=True)
    end = ears.wait_end(Role.PUBLISHES, "/chat")
    assert (end.type_name, end.node, end.hash) == (STRING, "/robot", STRING_HASH)
    assert end.qos is not None
    assert (end.qos.reliability, end.qos.durability, unmatched(end.qos)) == ("reliable", "transient_local", "")


def test_a_node_of_rclpy_sees_ours_with_its_type_and_hash(ears: Ears, robot: Peer) -> None:
    handle = ears.endpoint.advertise(ears.endpoint.channel("/ours", STRING))
    robot.ask("subscribe", topic="/ours", type=STRING)
    ears.wait(lambda _: ears.endpoint.subscribers(handle) == 1)
    seen = robot.ask("graph", topic="/ours")
    assert "gdp_proxy_0123456789ab" in str(seen["nodes"])
    assert seen["ends"] == [["gdp_proxy_0123456789ab", STRING, STRING_HASH, "VOLATILE"]]


def test_what_rclpy_publishes_is_heard_after_it_was_described(ears: Ears, robot: Peer) -> None:
    robot.tell("advertise", topic="/theirs", type=STRING, latched=True)
    ears.wait_end(Role.PUBLISHES, "/theirs")
    handle = ears.endpoint.subscribe("/theirs", STRING, default(latched=True))
    robot.tell("publish", topic="/theirs", hex=HELLO.hex())
    events = [each for each in ears.wait(lambda got: bool(heard(got))) if not isinstance(each, GraphChanged)]
    assert events[0] == TypeResolved(handle, ears.endpoint.channel("/theirs", STRING))
    assert heard(events) == [HELLO]


def test_what_we_publish_is_heard_by_rclpy(ears: Ears, robot: Peer) -> None:
    handle = ears.endpoint.advertise(ears.endpoint.channel("/said", STRING))
    robot.ask("subscribe", topic="/said", type=STRING)
    ears.wait(lambda _: ears.endpoint.subscribers(handle) == 1)
    ears.endpoint.publish(handle, HELLO)
    assert robot.wait_heard("/said", 1) == [digest(HELLO)]


def test_an_image_goes_both_ways_unchanged(ears: Ears, robot: Peer) -> None:
    image = "sensor_msgs/msg/Image"
    robot.tell("advertise", topic="/out", type=image)
    ears.wait_end(Role.PUBLISHES, "/out")
    ears.endpoint.subscribe("/out", image, default(depth=1_000))
    ours = ears.endpoint.advertise(ears.endpoint.channel("/back", image))
    robot.ask("subscribe", topic="/back", type=image)
    ears.wait(lambda _: ears.endpoint.subscribers(ours) == 1)
    sent = robot.ask("image", topic="/out")
    (raw,) = heard(ears.wait(lambda got: bool(heard(got))))
    assert (len(raw), digest(raw)) == (sent["size"], sent["digest"])
    ears.endpoint.publish(ours, raw)
    assert robot.wait_heard("/back", 1) == [sent["digest"]]


def test_a_late_joiner_gets_what_was_latched(ears: Ears, robot: Peer) -> None:
    channel = Channel("/map", STRING, 2, hash=STRING_HASH, qos=(default(latched=True, depth=2),))
    handle = ears.endpoint.advertise(channel)
    for text in (b"first", b"hello", b"world"):
        ears.endpoint.publish(handle, HELLO.replace(b"hello", text))
    robot.tell("subscribe", topic="/map", type=STRING, latched=True)
    assert robot.wait_heard("/map", 2) == [digest(HELLO), digest(HELLO.replace(b"hello", b"world"))]


def test_a_subscription_of_rclpy_is_seen_with_what_it_requests(ears: Ears, robot: Peer) -> None:
    robot.ask("subscribe", topic="/wanted", type=STRING, latched=True)
    end = ears.wait_end(Role.SUBSCRIBES, "/wanted")
    assert (end.type_name, end.node, end.hash) == (STRING, "/robot", STRING_HASH)
    assert end.qos is not None
    assert (end.qos.reliability, end.qos.durability, unmatched(end.qos)) == ("reliable", "transient_local", "")


def test_a_closed_subscription_gets_no_more_events(ears: Ears, robot: Peer) -> None:
    robot.tell("advertise", topic="/closed", type=STRING, latched=True)
    robot.tell("publish", topic="/closed", hex=HELLO.hex())
    end = ears.wait_end(Role.PUBLISHES, "/closed")
    first = ears.endpoint.subscribe("/closed", STRING, end.qos)
    ears.endpoint.close(first)
    second = ears.endpoint.subscribe("/closed", STRING, end.qos)
    events = ears.wait(lambda got: bool(heard(got)))
    assert {each.handle for each in events if not isinstance(each, GraphChanged)} == {second}


def test_a_stalled_reader_delays_no_other(ears: Ears, domain: int) -> None:
    image = "sensor_msgs/msg/Image"
    with peer("rclpy", domain) as second:
        second.ask("subscribe", topic="/still", type=image)
        handle = ears.endpoint.advertise(Channel("/still", image, 2, qos=(default(depth=5),)))
        ears.wait(lambda _: ears.endpoint.subscribers(handle) == 1)
        second.process.send_signal(signal.SIGSTOP)
        for _ in range(30):
            ears.endpoint.publish(handle, HELLO + bytes(921_600))
        second.process.send_signal(signal.SIGCONT)
        assert not [each for each in ears.endpoint.poll_events() if isinstance(each, EndpointError)]


def test_an_end_that_leaves_is_gone_from_the_graph(ears: Ears, domain: int) -> None:
    with peer("rclpy", domain) as second:
        second.tell("advertise", topic="/short", type=STRING)
        ears.wait_end(Role.PUBLISHES, "/short")
        second.tell("leave")
        ears.wait(lambda _: not any(end.name == "/short" for end in ears.endpoint.graph()))


def test_an_unknown_type_is_received_as_bytes(ears: Ears, robot: Peer) -> None:
    pytest.importorskip("test_msgs", reason="test_msgs is not installed")
    robot.tell("advertise", topic="/odd", type="test_msgs/msg/Empty", latched=True)
    end = ears.wait_end(Role.PUBLISHES, "/odd")
    handle = ears.endpoint.subscribe("/odd", "test_msgs/msg/Empty", end.qos)
    robot.tell("publish", topic="/odd", hex="0001000000")
    events = ears.wait(lambda got: bool(heard(got)))
    assert end.hash.startswith("RIHS01_")
    assert TypeResolved(handle, Channel("/odd", "test_msgs/msg/Empty", 2, hash=end.hash)) in events


def test_another_definition_of_a_local_type_is_refused(ears: Ears, robot: Peer) -> None:
    robot.tell("advertise", topic="/other", type=STRING)
    ears.wait_end(Role.PUBLISHES, "/other")
    with pytest.raises(LocalError, match="on this machine, not RIHS01_00"):
        ears.endpoint.advertise(Channel("/other", STRING, 2, hash="RIHS01_" + "00" * 32))


def test_a_service_with_a_peer_of_another_vendor_is_refused_with_a_reason(ears: Ears, robot: Peer) -> None:
    robot.ask("serve", topic="/set", type="std_srvs/srv/SetBool")
    end = ears.wait_end(Role.SERVES, "/set")
    assert (end.type_name, end.node, end.hash[:7]) == ("std_srvs/srv/SetBool", "/robot", "RIHS01_")
    handle = ears.endpoint.create_client("/set", "std_srvs/srv/SetBool")
    ears.endpoint.call(handle, 7, b"\x00\x01\x00\x00\x01\x00\x00\x00")
    events = ears.wait(lambda got: any(getattr(each, "call", 0) == 7 for each in got))
    (fault,) = [each.reason for each in events if isinstance(each, EndpointError)]
    assert "Fast DDS" in fault
    assert "endpoint ros2" in fault


def test_a_request_of_another_vendor_is_never_taken_for_one_of_ours(ears: Ears, robot: Peer) -> None:
    kind = "test_msgs/srv/BasicTypes"
    pytest.importorskip("test_msgs", reason="test_msgs is not installed")
    halves = [Channel("/basic", f"{kind}_{half}", 2) for half in ("Request", "Response")]
    handle = ears.endpoint.serve(Service("/basic", kind, "", halves[0], halves[1]))
    robot.ask("call", topic="/basic", type=kind)
    events = ears.wait(lambda got: any(isinstance(each, EndpointError) for each in got))
    ears.endpoint.advertise(ears.endpoint.channel("/after", STRING))
    robot.ask("subscribe", topic="/after", type=STRING)
    ears.wait_end(Role.SUBSCRIBES, "/after")
    events += ears.endpoint.poll_events()
    assert [each.handle for each in events if isinstance(each, EndpointError)] == [handle]
    assert not [each for each in events if isinstance(each, RequestReceived)]
