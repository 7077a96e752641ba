"""Coordinate frames in messages of every standard type of both ROS, drawn and read back by another implementation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields
from random import Random
from typing import Any, Final

import pytest
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gdp.errors import RemoteError
from proxy.config.frames import Frames
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.frames import FrameRewriter
from tests.proxy.bridge.known import channel
from tests.proxy.serial.drawn import drawn_message, wire_of

STORES: Final[dict[RosVersion, Typestore]] = {
    1: get_typestore(Stores.ROS1_NOETIC),
    2: get_typestore(Stores.ROS2_JAZZY),
}
FIELDS: Final = ("frame_id", "child_frame_id")
ADDED: Final = Frames(add="robot1/", common=("map",))
NAMES: Final = ("base_link", "map", "", "/odom", "żółw")
TEXTS: Final = dict.fromkeys(FIELDS, NAMES)


def _rename(value: Any, renamed: Callable[[bytes], bytes]) -> int:
    """Rename the frames of a message as rosbags has it; return how many there are."""
    if isinstance(value, list):
        return sum(_rename(each, renamed) for each in value)
    count = 0
    for field in fields(value) if hasattr(value, "__msgtype__") else ():
        inner = getattr(value, field.name)
        if isinstance(inner, str) and field.name in FIELDS:
            object.__setattr__(value, field.name, renamed(inner.encode()).decode())
            count += 1
        elif not isinstance(inner, str):
            count += _rename(inner, renamed)
    return count


def _typed() -> Iterator[tuple[RosVersion, str]]:
    for ros, store in STORES.items():
        for type_name in sorted(store.fielddefs):
            if "/msg/" in type_name and "builtin_interfaces" not in type_name:
                yield ros, type_name


@pytest.mark.parametrize("ros", [1, 2])
def test_frames_of_every_standard_type_are_renamed_and_nothing_else(ros: RosVersion) -> None:
    store, with_frames = STORES[ros], 0
    for number, type_name in enumerate(name for each, name in _typed() if each == ros):
        message = drawn_message(store, type_name, Random(number), TEXTS)
        raw = wire_of(store, ros, message, type_name)
        got = FrameRewriter(channel(type_name, ros), ADDED.rename).rewrite(raw)
        with_frames += bool(_rename(message, ADDED.rename))
        assert got == wire_of(store, ros, message, type_name), type_name
    assert with_frames >= 50


@pytest.mark.parametrize(
    ("frames", "frame", "here"),
    [
        (ADDED, "base_link", "robot1/base_link"),
        (ADDED, "/base_link", "robot1/base_link"),
        (ADDED, "map", "map"),
        (ADDED, "/map", "/map"),
        (ADDED, "", ""),
        (Frames(remove="robot1/"), "robot1/map", "map"),
        (Frames(remove="robot1/"), "robot2/map", "robot2/map"),
        (Frames(remove="robot1/"), "robot1/", "robot1/"),
    ],
)
def test_a_frame_is_called(frames: Frames, frame: str, here: str) -> None:
    assert frames.rename(frame.encode()).decode() == here


@pytest.mark.parametrize("values", [{}, {"add": "a/", "remove": "b/"}, {"add": "a b"}, {"add": "x" * 256}])
def test_frames_are_added_to_or_taken_from_by_a_text_that_a_frame_may_have(values: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"expected either|pattern|at most"):
        Frames.model_validate(values)


def test_bytes_of_another_type_are_refused() -> None:
    about: Channel = channel("sensor_msgs/msg/Image")
    with pytest.raises(RemoteError, match="frames"):
        FrameRewriter(about, ADDED.rename).rewrite(b"\0\1\0\0\1")
