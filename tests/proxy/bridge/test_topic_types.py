"""Types from end to end: encodings, ROS 1 and ROS 2, custom types, and types unknown on the far side."""

from __future__ import annotations

from pathlib import Path

import pytest

from proxy.serial.channel import RosVersion
from tests.proxy.bridge import known
from tests.proxy.bridge.known import IMAGE, STRING, custom, image, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites, named
from tests.proxy.endpoints.fake import FakeGraph

CHATTER = f"name: /chatter, type: {STRING}"
CUSTOM = "own_msgs/msg/Pose"
POSE = f"name: /pose, type: {CUSTOM}"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def graph(ros: RosVersion = 2, pose: str | None = None) -> FakeGraph:
    """Return a graph with this definition of the custom type, or without it."""
    types = known.channels(ros)
    return FakeGraph(ros, types if pose is None else types | {CUSTOM: custom(CUSTOM, pose, ros)})


@pytest.mark.parametrize("encoding", ["json", "cbor", "cdr"])
@pytest.mark.parametrize("there", [1, 2])
@pytest.mark.parametrize("here", [1, 2])
def test_images_and_texts_arrive_in_the_dialect_of_the_listener(
    sites: Sites, encoding: str, there: RosVersion, here: RosVersion
) -> None:
    both = [f"{rule}, encoding: {encoding}" for rule in (CHATTER, f"name: /image, type: {IMAGE}")]
    robot, server = sites.add(ROBOT, expose=both, ros=there), sites.add(SERVER, imports=both, ros=here)
    texts, images = Ear(server.graph, "/chatter"), Ear(server.graph, "/image", IMAGE)
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    camera = robot.graph.publish("/camera", "/image", IMAGE)
    assert sites.run(3, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    pixels = bytes(range(256)) * 50
    talker.publish(string("grüße", there))
    camera.publish(image(pixels, there))
    assert sites.run(2, lambda: bool(texts.heard and images.heard))
    assert (texts.heard, images.heard) == ([string("grüße", here)], [image(pixels, here)])
    assert (robot.faults, server.faults) == ({}, {})


def test_both_directions_between_ros_1_and_ros_2_at_once(sites: Sites) -> None:
    up, down = "name: /up, type: " + STRING, "name: /down, type: " + STRING
    one, two = sites.add(ROBOT, expose=[up], imports=[down], ros=1), sites.add(SERVER, expose=[down], imports=[up])
    ears = Ear(two.graph, "/up"), Ear(one.graph, "/down")
    talkers = one.graph.publish("/t", "/up", STRING), two.graph.publish("/t", "/down", STRING)
    assert sites.run(3, lambda: one.is_read() and two.is_read())
    talkers[0].publish(string("up", 1))
    talkers[1].publish(string("down", 2))
    assert sites.run(1, lambda: [ear.texts for ear in ears] == [["up"], ["down"]])


def test_one_proxy_in_a_graph_of_each_ros_carries_for_both(sites: Sites) -> None:
    old, new = graph(1), graph(2)
    up, down = f"name: /up, type: {STRING}", f"name: /down, type: {STRING}"
    robot = sites.add(ROBOT, expose=[f"{up}, ros: 1"], imports=[f"{down}, ros: 2"], graph=old, more=new)
    server = sites.add(SERVER, expose=[down], imports=[up])
    ears = Ear(server.graph, "/up"), Ear(new, "/down"), Ear(old, "/down")
    talkers = old.publish("/t", "/up", STRING), server.graph.publish("/t", "/down", STRING)
    unnamed = new.publish("/t", "/up", STRING)
    assert sites.run(3, lambda: robot.is_read() and server.is_read())
    talkers[0].publish(string("up", 1))
    talkers[1].publish(string("down"))
    unnamed.publish(string("stays"))
    sites.run(2)
    assert [ear.heard for ear in ears] == [[string("up")], [string("down")], []]


def test_a_custom_type_crosses_to_a_machine_that_does_not_know_it(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[POSE], graph=graph(2, "int32 x\nint32 y\n"))
    server = sites.add(SERVER, imports=[POSE], graph=graph())
    ear, talker = Ear(server.graph, "/pose", CUSTOM), robot.graph.publish("/t", "/pose", CUSTOM)
    assert sites.run(3, robot.is_read)
    raw = b"\0\1\0\0" + bytes(range(8))
    talker.publish(raw)
    assert sites.run(1, lambda: ear.heard == [raw])


def test_a_custom_type_crosses_to_the_other_ros_which_does_not_know_it(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[POSE], graph=graph(2, "int32 x\nint32 y\n"))
    server = sites.add(SERVER, imports=[POSE], graph=graph(1))
    ear, talker = Ear(server.graph, "/pose", CUSTOM), robot.graph.publish("/t", "/pose", CUSTOM)
    assert sites.run(3, robot.is_read)
    talker.publish(b"\0\1\0\0" + bytes(range(8)))
    assert sites.run(1, lambda: ear.heard == [bytes(range(8))])


def test_definitions_that_differ_are_reported_once_with_the_first_difference_and_the_rest_flows(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot = sites.add(ROBOT, expose=[POSE, CHATTER], graph=graph(2, "int32 x\nint32 y\n"))
    server = sites.add(SERVER, imports=[POSE, CHATTER], graph=graph(2, "int32 x\nfloat64 y\n"))
    poses, texts = Ear(server.graph, "/pose", CUSTOM), Ear(server.graph, "/chatter")
    talker, other = robot.graph.publish("/t", "/pose", CUSTOM), robot.graph.publish("/t", "/chatter", STRING)
    assert sites.run(3, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    for _ in range(3):
        talker.publish(b"\0\1\0\0" + bytes(8))
    other.publish(string("hello"))
    assert sites.run(1, lambda: texts.texts == ["hello"])
    assert poses.heard == []
    (reported,) = caplog.messages
    assert reported.startswith("/pose: other-type: ")
    assert "y: int32 there, float64 here" in reported
    assert [stats.refused for stats in server.bridge.stats if stats.topic == "/pose"] == [3]


@pytest.mark.parametrize(("there", "here"), [(2, 2), (1, 2), (2, 1)])
def test_a_rule_may_allow_fields_that_one_side_lacks_and_they_are_named_once(
    sites: Sites, caplog: pytest.LogCaptureFixture, there: RosVersion, here: RosVersion
) -> None:
    robot = sites.add(ROBOT, expose=[POSE], graph=graph(there, "int32 x\nint32 old\n"))
    server = sites.add(SERVER, imports=[f"{POSE}, fields: default"], graph=graph(here, "int32 x\nint32 new\n"))
    ear, talker = Ear(server.graph, "/pose", CUSTOM), robot.graph.publish("/t", "/pose", CUSTOM)
    assert sites.run(3, robot.is_read)
    encapsulation = {1: b"", 2: b"\0\1\0\0"}
    for number in range(3):
        talker.publish(encapsulation[there] + bytes([number, 0, 0, 0, 9, 0, 0, 0]))
    assert sites.run(1, lambda: len(ear.heard) == 3)
    assert ear.heard == [encapsulation[here] + bytes([number, *bytes(7)]) for number in range(3)]
    (reported,) = caplog.messages
    assert reported == (
        "/pose: other-type: messages are converted: old: not known here, dropped; new: not known there, has its default"
    )


def test_definitions_that_differ_between_ros_1_and_ros_2_are_reported(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot = sites.add(ROBOT, expose=[POSE], graph=graph(1, "int32 x\nint32 y\n"))
    server = sites.add(SERVER, imports=[POSE], graph=graph(2, "int32 x\nint64 y\n"))
    ear, talker = Ear(server.graph, "/pose", CUSTOM), robot.graph.publish("/t", "/pose", CUSTOM)
    assert sites.run(3, robot.is_read)
    talker.publish(bytes(8))
    sites.run(1)
    assert ear.heard == []
    assert any("y: int32 there, int64 here" in text for text in caplog.messages)


def test_a_type_that_the_other_ros_cannot_have_is_reported(sites: Sites, caplog: pytest.LogCaptureFixture) -> None:
    robot = sites.add(ROBOT, expose=[POSE], graph=graph(2, "wstring name\n"))
    server = sites.add(SERVER, imports=[POSE], graph=graph(1))
    Ear(server.graph, "/pose", CUSTOM)
    talker = robot.graph.publish("/t", "/pose", CUSTOM)
    assert sites.run(3, robot.is_read)
    talker.publish(b"\0\1\0\0" + bytes(4))
    sites.run(1)
    (reported,) = caplog.messages
    assert "/pose" in reported
    assert "name: wstring has no form in ROS 1" in reported


def test_a_type_that_its_own_machine_does_not_know_is_reported_and_the_rest_flows(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot = sites.add(ROBOT, expose=[POSE, CHATTER])
    server = sites.add(SERVER, imports=[CHATTER])
    robot.graph.publish("/t", "/pose", CUSTOM)
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/t", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    assert caplog.messages == [f"/pose: unknown-type: {CUSTOM}: not installed"]


def test_a_local_type_that_is_not_the_rules_is_reported(sites: Sites, caplog: pytest.LogCaptureFixture) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER])
    robot.graph.publish("/talker", "/chatter", IMAGE)
    sites.run(2)
    assert robot.carried == set()
    assert caplog.messages == [f"/chatter: other-type: local nodes use {IMAGE}; the rule says {STRING}"]


def test_several_types_on_one_name_are_reported_and_the_rules_type_crosses(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    robot.graph.publish("/other", "/chatter", IMAGE)
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    (reported,) = caplog.messages
    assert IMAGE in reported
    assert STRING in reported


def test_a_local_reader_of_another_type_receives_nothing_and_is_reported(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    robot.graph.publish("/talker", "/chatter", STRING)
    ear = Ear(server.graph, "/chatter", IMAGE)
    sites.run(3)
    assert ear.heard == []
    assert [text for text in caplog.messages if text.startswith("/chatter: other-type: ")]


def test_a_body_that_does_not_fit_its_definition_is_counted_and_the_rest_flows(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER], ros=1), sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    for raw in (b"\xff\xff\xff\xff", b"", string("hello", 1)):
        talker.publish(raw)
    assert sites.run(1, lambda: ear.texts == ["hello"])
    assert server.faults == {"malformed": 2}
    (reported,) = caplog.messages
    assert reported.startswith("/chatter: malformed: ")


def test_what_far_peers_may_send_never_stops_a_proxy(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    for wire in (b"", b"\x01", b"\x07" + bytes(30), b"\x01\x00\x00" + bytes(8) + b"{}", b"\x01\x00\x00" + bytes(8)):
        robot.stream.publish(wire)
    robot.stream.describe(b"no description at all")
    sites.run(1)
    robot.stream.publish(bytes(40))
    sites.run(1)
    assert (set(server.faults), ear.heard) == ({"malformed"}, [])
    assert talker.graph is robot.graph


def test_a_far_type_that_is_not_the_rules_never_meets_it(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[f"name: /chatter, type: {IMAGE}"])
    server = sites.add(SERVER, imports=["name: /chatter"], holds=[named("/chatter", STRING)])
    ear = Ear(server.graph, "/chatter")
    robot.graph.publish("/camera", "/chatter", IMAGE).publish(image(b"12"))
    sites.run(3)
    assert (ear.heard, robot.is_read()) == ([], False)
