"""Generator of the demonstration recording."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from proxy.recordings.reader import BagReader
from proxy.serial.serializer import canonical

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "make_demo_bag.py"


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *arguments]
    root = SCRIPT.parents[1]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module", params=["demo.mcap", "demo.bag"])
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("demo") / str(request.param)
    made = make("--seconds", "1", "-o", str(path), *(["--ros1"] if path.suffix == ".bag" else []))
    assert made.returncode == 0, made.stderr
    return path


@pytest.mark.parametrize("name", ["demo.mcap", "demo.bag"])
def test_the_same_arguments_give_the_same_bytes(name: str, tmp_path: Path) -> None:
    made = []
    for folder in (tmp_path / "one", tmp_path / "two"):
        folder.mkdir()
        make("--seconds", "0.1", "-o", str(folder / name), *(["--ros1"] if name == "demo.bag" else []))
        made.append((folder / name).read_bytes())
    assert made[0] == made[1]


def test_every_topic_has_its_rate(bag: Path) -> None:
    with BagReader(bag) as recording:
        topics = [recording.channels[message.channel].topic for message in recording.messages()]
    assert {topic: topics.count(topic) for topic in topics} == {
        "/camera/image": 10,
        "/scan": 10,
        "/imu": 100,
        "/odom": 20,
        "/tf": 20,
        "/tf_static": 1,
        "/map": 1,
    }


def test_the_static_topics_are_latched_and_no_others(bag: Path) -> None:
    with BagReader(bag) as recording:
        assert {channel.topic for channel in recording.channels if channel.latched} == {"/tf_static", "/map"}


def test_every_message_is_canonical_already(bag: Path) -> None:
    with BagReader(bag) as recording:
        for message in recording.messages():
            assert canonical(recording.channels[message.channel], message.raw) == message.raw


def test_the_scan_has_nan_and_both_infinities_and_the_camera_sees_a_moving_scene(bag: Path) -> None:
    with AnyReader([bag]) as recording:
        seen: dict[str, list[Any]] = {"/scan": [], "/camera/image": []}
        for connection, _, raw in recording.messages():
            if connection.topic in seen:
                seen[connection.topic].append(recording.deserialize(raw, connection.msgtype))
    ranges = seen["/scan"][0].ranges
    assert np.isnan(ranges).any()
    assert np.isposinf(ranges).any()
    assert np.isneginf(ranges).any()
    first, second = (image.data.reshape(480, 640, 3).astype(int) for image in seen["/camera/image"][:2])
    assert (first != second).mean() > 0.5
    assert np.abs(np.diff(first, axis=1)).mean() < 8  # neighbours are alike: a scene, not noise


def test_an_existing_file_is_not_replaced(bag: Path) -> None:
    refused = make("-o", str(bag))
    assert refused.returncode == 2
    assert "exists already" in refused.stderr


def test_help_has_an_example() -> None:
    assert "example:" in make("--help").stdout


def test_without_images_everything_else_is_there(tmp_path: Path) -> None:
    path = tmp_path / "small.mcap"
    made = make("--seconds", "0.1", "--without-images", "-o", str(path))
    assert made.returncode == 0, made.stderr
    with BagReader(path) as bag:
        topics = {channel.topic for channel in bag.channels}
    assert topics == {"/tf_static", "/map", "/scan", "/imu", "/odom", "/tf"}
    assert path.stat().st_size < 100_000
