"""Types without fields, such as ``std_msgs/msg/Empty`` and Trigger's request: no text is a definition, too."""

from __future__ import annotations

from typing import Final

import pytest

from proxy.recordings.channels import from_ros2
from proxy.serial.channel import EMPTY_MD5, Channel, Service, ros1_format
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.rosbridge_json import RosbridgeCodec
from proxy.serial.service_converter import translated_service
from proxy.serial.standard_types import known_channel
from proxy.tools.message_text import MessageText, request_of

_EMPTY: Final = "std_msgs/msg/Empty"
_ROS1: Final = Channel("/e", _EMPTY, 1, hash=EMPTY_MD5, definition_format="msg")
_RAW1, _RAW2 = b"", b"\x00\x01\x00\x00\x00"  # rosidl: no CDR structure is empty
_TRIGGER1: Final = Service(
    "/go",
    "std_srvs/srv/Trigger",
    "937c9679a518e3a18d831e57125ea522",
    Channel("/go", "std_srvs/srv/Trigger_Request", 1, hash=EMPTY_MD5, definition_format="msg"),
    Channel(
        "/go", "std_srvs/srv/Trigger_Response", 1, definition="bool success\nstring message\n", definition_format="msg"
    ),
)


def ros2() -> Channel:
    return known_channel("/e", _EMPTY)


@pytest.mark.parametrize(
    ("text", "md5", "expected"),
    [("", EMPTY_MD5, "msg"), ("", "", ""), ("", "992ce8a1687cec8c8bd883ec73ca41d1", ""), ("string data", "", "msg")],
)
def test_an_empty_text_of_ros_1_is_a_definition_where_the_md5_sum_says_so(text: str, md5: str, expected: str) -> None:
    assert ros1_format(text, md5) == expected


def test_it_crosses_between_ros_1_and_ros_2() -> None:
    two = ros2()
    assert two.definition_format == "msg"
    assert translated_channel(_ROS1, 2) == two
    assert translated_channel(two, 1) == _ROS1
    assert MessageConverter(_ROS1, two).convert(_RAW1) == _RAW2
    assert MessageConverter(two, _ROS1).convert(_RAW2) == _RAW1


def test_a_service_with_one_crosses_between_ros_1_and_ros_2() -> None:
    two = translated_service(_TRIGGER1, 2)
    assert two.hash.startswith("RIHS01_")
    assert two.request.definition_format == "msg"
    assert translated_service(two, 1).hash == _TRIGGER1.hash


def test_it_keeps_its_definition_on_the_wire() -> None:
    assert Channel.from_cbor(ros2().to_wire()) == ros2()


def test_a_recording_without_its_definition_gets_that_of_the_standard_type() -> None:
    assert from_ros2("/e", _EMPTY, "", "", "", []).definition_format == "msg"


def test_tools_and_the_rosbridge_door_write_and_read_it() -> None:
    assert request_of(translated_service(_TRIGGER1, 2).request, {}) == _RAW2
    assert RosbridgeCodec(ros2()).to_raw({}) == _RAW2
    assert bytes(RosbridgeCodec(ros2()).to_json(_RAW2)) == b"{}"
    assert MessageText(ros2()).to_yaml(_RAW2) == "{}\n"
