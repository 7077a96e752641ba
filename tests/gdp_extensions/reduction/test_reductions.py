"""Topics whose rules make messages smaller: both graphs have the same messages, and fewer bytes travel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gdp.errors import LocalError
from gdp_extensions.reduction import picture
from gdp_extensions.reduction.compression import BodyCompressor
from gdp_extensions.reduction.image import ImageReducer
from gdp_extensions.reduction.picture import HAS_LIBRARY
from proxy.config.recorded import RecordedRules
from proxy.config.reduction import CLOUD, IMAGE
from proxy.serial.channel import RosVersion
from proxy.wire.message import RosMessage, Step, TopicDescription
from tests.gdp_extensions.reduction.samples import channel, cloud, cloud_of, image, image_of, pixels_of
from tests.gdp_extensions.reduction.test_compression import DICTIONARY
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph, Publication
from tests.proxy.rule_files import refusals, rule, rules

CHATTER = f"name: /chatter, type: {STRING}"
CAMERA = f"name: /camera, type: {IMAGE}"
SHADE = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8)
needs_pillow = pytest.mark.skipif(not HAS_LIBRARY, reason="Pillow is not installed")


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def flowing(
    sites: Sites, more: str, of: str = CHATTER, into: str = "", far: RosVersion = 2
) -> tuple[Machine, Machine, Publication, Ear]:
    """Return both machines, a talker and a listener, about a topic whose exposing rule says ``more``."""
    name, type_name = (each.partition(": ")[2] for each in of.split(", "))
    graphs = [
        FakeGraph(ros, {each: replace(channel(each, ros), topic="") for each in (STRING, IMAGE, CLOUD)})
        for ros in (2, far)
    ]
    robot = sites.add(ROBOT, expose=[f"{of}{more}"], graph=graphs[0])
    server = sites.add(SERVER, imports=[f"{of}{into}"], graph=graphs[1], ros=far)
    ear = Ear(server.graph, name, type_name)
    talker = robot.graph.publish("/talker", name, type_name)
    assert sites.run(3, robot.is_read)
    return robot, server, talker, ear


@pytest.mark.parametrize("encoding", ["json", "cbor", "cdr"])
def test_compressed_messages_arrive_as_they_were_in_fewer_bytes(sites: Sites, encoding: str) -> None:
    robot, server, talker, ear = flowing(sites, f", compress: zstd, encoding: {encoding}")
    texts = ["a text that repeats itself, " * 200, "short", "b" * 5_000]
    for text in texts:
        talker.publish(string(text))
    assert sites.run(2, lambda: len(ear.heard) == 3)
    assert ear.texts == texts
    assert robot.context.traffic.bytes_out == server.context.traffic.bytes_in < 400
    assert server.faults == {}


def test_what_does_not_shrink_travels_as_it_is(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites, ", compress: {level: 1}, encoding: cdr")
    talker.publish(raw := string("0"))
    assert sites.run(2, lambda: ear.heard == [raw])
    assert robot.context.traffic.bytes_out == 11 + len(raw)


def test_a_dictionary_reaches_the_reader_with_the_description(sites: Sites, tmp_path: Path) -> None:
    (tmp_path / "pose.dict").write_bytes(DICTIONARY)
    robot, _, talker, ear = flowing(sites, ", compress: {dictionary: pose.dict}, encoding: cdr")
    text = '{"frame_id": "base_3", "x": 4711, "y": 22193521}'
    talker.publish(string(text))
    assert sites.run(2, lambda: ear.texts == [text])
    assert robot.context.traffic.bytes_out < len(string(text))


@needs_pillow
@pytest.mark.parametrize("far", [1, 2])
def test_an_image_is_an_image_on_both_sides_and_a_file_between(sites: Sites, far: RosVersion) -> None:
    robot, server, talker, ear = flowing(sites, ", image: png, encoding: cdr", CAMERA, far=far)
    raw = image("mono8", SHADE.shape, SHADE)
    talker.publish(raw)
    assert sites.run(2, lambda: len(ear.heard) == 1)
    assert pixels_of(ear.heard[0], far).tolist() == SHADE.tolist()
    assert image_of(ear.heard[0], far).header.frame_id == "lens"
    assert robot.context.traffic.bytes_out < len(raw) / 2
    assert server.faults == {}


@needs_pillow
def test_a_jpeg_is_as_small_as_its_quality_says_and_depth_travels_as_it_is(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites, ", image: jpeg, quality: 20, encoding: cdr", CAMERA)
    talker.publish(image("mono8", SHADE.shape, SHADE))
    depth = image("32FC1", SHADE.shape, SHADE.astype(np.float32))
    talker.publish(depth)
    assert sites.run(2, lambda: len(ear.heard) == 2)
    assert len(ear.heard[0]) == len(image("mono8", SHADE.shape, SHADE))
    assert ear.heard[1] == depth
    assert robot.context.traffic.bytes_out < len(depth) + 1_000


def test_a_cloud_crosses_thinned(sites: Sites) -> None:
    robot, _, talker, ear = flowing(
        sites, ", voxel_m: 0.5, region: {x: [0, 1]}, encoding: cdr", f"name: /points, type: {CLOUD}"
    )
    points = np.random.default_rng(1).uniform(-2, 2, (1_000, 4)).astype(np.float32)
    talker.publish(cloud(points))
    assert sites.run(2, lambda: len(ear.heard) == 1)
    _, kept = cloud_of(ear.heard[0])
    assert 0 < len(kept) <= 2 * 8 * 8
    assert robot.context.traffic.bytes_out < 16 * 1_000 / 4


@needs_pillow
def test_a_publisher_without_the_library_says_so_and_sends_images_as_they_are(
    sites: Sites, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(picture, "HAS_LIBRARY", False)
    robot, _, talker, ear = flowing(sites, ", image: jpeg, encoding: cdr", CAMERA)
    raw = image("mono8", SHADE.shape, SHADE)
    talker.publish(raw)
    assert sites.run(2, lambda: ear.heard == [raw])
    assert robot.faults.keys() == {"no-library"}
    (said,) = caplog.messages
    assert "pip install 'gdp-ros[images]'" in said


@needs_pillow
def test_a_reader_without_the_library_says_so_once_and_counts_what_it_refused(
    sites: Sites, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _, server, talker, ear = flowing(sites, ", image: png, encoding: cdr", CAMERA)
    talker.publish(image("mono8", SHADE.shape, SHADE))
    assert sites.run(2, lambda: len(ear.heard) == 1)
    sent = image("mono8", SHADE.shape, SHADE)
    file = picture.encode_picture(sent[-SHADE.size :], picture.Layout(64, 48, "mono8", 64), "png", 80)
    assert file is not None
    monkeypatch.setattr(picture, "HAS_LIBRARY", False)
    monkeypatch.setattr("gdp_extensions.reduction.image.encode_picture", lambda *_: file)
    talker.publish(sent)
    talker.publish(sent)
    sites.run(2)
    assert server.faults == {"no-library": 2}
    assert [stats.refused for stats in server.bridge.stats] == [2]
    assert len([said for said in caplog.messages if "no-library" in said]) == 1


def say(sites: Sites, robot: Machine, description: TopicDescription, message: RosMessage) -> None:
    robot.stream.describe(description.to_wire())
    robot.member.flush(sites.now_s)
    sites.world.network.send_pending(robot.label)
    sites.run(0.5)
    robot.stream.publish(message.to_wire())
    robot.member.flush(sites.now_s)
    sites.world.network.send_pending(robot.label)
    sites.run(0.5)


def test_a_frame_that_would_fill_the_memory_is_refused_by_the_readers_own_limit(sites: Sites) -> None:
    robot, server, _, ear = flowing(sites, ", compress: zstd, encoding: cdr", into=", max_bytes: 1000")
    raw = string("0" * 5_000_000)
    frame = BodyCompressor(3).compress(raw)
    assert frame is not None
    source = replace(channel(STRING), topic="/chatter")
    say(sites, robot, TopicDescription("cdr", (source,), is_compressed=True), RosMessage(0, 1, frame, Step.ZSTD))
    assert (ear.heard, server.faults) == ([], {"malformed": 1})


@pytest.mark.parametrize("step", [Step.ZSTD, Step.IMAGE, Step.IMAGE | Step.ZSTD])
def test_a_step_that_the_description_does_not_state_is_refused(sites: Sites, step: Step) -> None:
    robot, server, _, ear = flowing(sites, ", encoding: cdr")
    source = replace(channel(STRING), topic="/chatter")
    say(sites, robot, TopicDescription("cdr", (source,)), RosMessage(0, 1, string("x"), step))
    assert (ear.heard, server.faults) == ([], {"malformed": 1})


def test_a_picture_file_in_a_message_that_is_no_image_is_refused(sites: Sites) -> None:
    robot, server, _, ear = flowing(sites, ", encoding: cdr")
    source = replace(channel(STRING), topic="/chatter")
    say(sites, robot, TopicDescription("cdr", (source,), image="png"), RosMessage(0, 1, string("x"), Step.IMAGE))
    assert (ear.heard, server.faults) == ([], {"malformed": 1})


def test_an_importing_rule_with_a_reduction_is_refused(tmp_path: Path) -> None:
    Sites(tmp_path)
    (line,) = refusals(
        tmp_path, "ros: {endpoint: ros2, domain: 0}\nimport:\n" + rules("name: /a, compress: zstd, voxel_m: null")
    )[:1]
    assert "this stands in rules under expose" in line


def test_a_replayed_recording_keeps_its_messages_and_may_be_compressed(tmp_path: Path) -> None:
    Sites(tmp_path)
    said = rule(tmp_path, "name: /a, image: jpeg, compress: zstd, voxel_m: 1, region: {x: [0, 1]}, adapt: true")
    (replayed,) = RecordedRules.of(expose=[said]).expose
    assert (replayed.image, replayed.voxel_m, replayed.region, replayed.adapt) == (None, None, None, None)
    assert replayed.compress is not None


@needs_pillow
def test_an_image_without_a_definition_cannot_be_reduced() -> None:
    with pytest.raises(LocalError):
        ImageReducer(replace(channel(IMAGE), definition="", definition_format=""), "png", None)
