"""Frames and stamps in messages of every standard type of both ROS, drawn and read back by another implementation."""

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
from proxy.serial.headers import HeaderRewriter, StampShift
from tests.proxy.bridge.known import channel
from tests.proxy.serial.drawn import drawn_message, wire_of

STORES: Final[dict[RosVersion, Typestore]] = {
    1: get_typestore(Stores.ROS1_NOETIC),
    2: get_typestore(Stores.ROS2_JAZZY),
}
FIELDS: Final = ("frame_id", "child_frame_id")
ADDED: Final = Frames(add="robot1/", common=("map",))
NAMES: Final = ("base_link", "map", "", "/odom", "żółw")
NO_SHIFT: Final = StampShift(0, 0)
SENT_NS: Final = 1_750_000_000_250_000_000
SHIFT: Final = StampShift(-2_500_000_000, SENT_NS)
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
        got = HeaderRewriter(channel(type_name, ros), ADDED.rename).rewrite(raw, NO_SHIFT)
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
    with pytest.raises(RemoteError, match="header"):
        HeaderRewriter(about, ADDED.rename).rewrite(b"\0\1\0\0\1", NO_SHIFT)


def _set_stamps(value: Any, of_header: int, of_other: int) -> int:
    """Set each time of a message, that of headers to one and others to another moment; return how many headers."""
    if isinstance(value, list):
        return sum(_set_stamps(each, of_header, of_other) for each in value)
    count = 0
    for field in fields(value) if hasattr(value, "__msgtype__") else ():
        inner = getattr(value, field.name)
        if getattr(inner, "__msgtype__", "") == "builtin_interfaces/msg/Time":
            is_header = value.__msgtype__ == "std_msgs/msg/Header"
            sec, nanosec = divmod(of_header if is_header else of_other, 10**9)
            object.__setattr__(value, field.name, type(inner)(sec, nanosec))
            count += is_header
        else:
            count += _set_stamps(inner, of_header, of_other)
    return count


@pytest.mark.parametrize("ros", [1, 2])
def test_stamps_of_headers_of_every_standard_type_are_moved_and_no_other_time(ros: RosVersion) -> None:
    store, with_stamps = STORES[ros], 0
    for number, type_name in enumerate(name for each, name in _typed() if each == ros):
        message = drawn_message(store, type_name, Random(number), TEXTS)
        _set_stamps(message, SENT_NS - 40_000_000, SENT_NS)
        raw = wire_of(store, ros, message, type_name)
        got = HeaderRewriter(channel(type_name, ros), None, has_stamps=True).rewrite(raw, SHIFT)
        with_stamps += bool(_set_stamps(message, SENT_NS - 2_540_000_000, SENT_NS))
        assert got == wire_of(store, ros, message, type_name), type_name
    assert with_stamps >= 50


@pytest.mark.parametrize("ros", [1, 2])
def test_the_clock_of_a_simulation_passes_untouched(ros: RosVersion) -> None:
    message = STORES[ros].types["rosgraph_msgs/msg/Clock"](STORES[ros].types["builtin_interfaces/msg/Time"](5, 6))
    raw = wire_of(STORES[ros], ros, message, "rosgraph_msgs/msg/Clock")
    rewriter = HeaderRewriter(channel("rosgraph_msgs/msg/Clock", ros), None, has_stamps=True)
    assert rewriter.rewrite(raw, StampShift(10**9, 5 * 10**9)) is raw


@pytest.mark.parametrize(
    ("at_ns", "here_ns"),
    [
        (SENT_NS, SENT_NS - 2_500_000_000),
        (SENT_NS + 3_600 * 10**9, SENT_NS + 3_597_500_000_000),
        (SENT_NS + 3_601 * 10**9, SENT_NS + 3_601 * 10**9),
        (12_000_000_345, 12_000_000_345),  # of a simulation
        (0, 0),  # "latest"
    ],
)
def test_a_stamp_of_the_senders_clock_alone_is_moved(at_ns: int, here_ns: int) -> None:
    sec, nanosec = divmod(at_ns, 10**9)
    moved = SHIFT.moved({"sec": sec, "nanosec": nanosec})
    assert moved["sec"] * 10**9 + moved["nanosec"] == here_ns


def test_a_stamp_that_no_message_can_have_is_refused() -> None:
    store = STORES[2]
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](2**31 - 1, 0), "map")
    raw = wire_of(store, 2, header, "std_msgs/msg/Header")
    rewriter = HeaderRewriter(channel("std_msgs/msg/Header"), None, has_stamps=True)
    with pytest.raises(RemoteError, match="header"):
        rewriter.rewrite(raw, StampShift(10**9, (2**31 - 1) * 10**9))
