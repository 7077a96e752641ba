"""Types known to the machines of these tests, and messages of some of them in either ROS's wire form."""

from __future__ import annotations

import struct
from functools import cache
from typing import Final

from rosbags.typesys import Stores, get_typestore

from proxy.serial.channel import Channel, RosVersion, Service
from proxy.serial.service_converter import translated_service
from proxy.serial.standard_types import type_hash

__all__ = [
    "FIBONACCI",
    "IMAGE",
    "SET_BOOL",
    "STRING",
    "TRANSFORMS",
    "TRIGGER",
    "channel",
    "channels",
    "image",
    "service",
    "services",
    "string",
    "switch",
    "switched",
    "text_of",
]

STRING: Final = "std_msgs/msg/String"
IMAGE: Final = "sensor_msgs/msg/Image"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
SET_BOOL: Final = "std_srvs/srv/SetBool"
TRIGGER: Final = "std_srvs/srv/Trigger"
FIBONACCI: Final = "test_msgs/action/Fibonacci"
_CDR: Final = b"\x00\x01\x00\x00"
_LINE: Final = "=" * 80 + "\n"
_SERVICES: Final = {
    SET_BOOL: ("bool data\n", "bool success\nstring message\n"),
    TRIGGER: ("", "bool success\nstring message\n"),
    "test_msgs/action/Fibonacci_SendGoal": ("uint8[16] goal_id\nint32 order\n", "bool accepted\n"),
    "action_msgs/srv/CancelGoal": ("uint8[16] goal_id\n", "int8 return_code\n"),
    "test_msgs/action/Fibonacci_GetResult": ("uint8[16] goal_id\n", "int8 status\nint32[] sequence\n"),
}
_TOPICS: Final = {
    "test_msgs/action/Fibonacci_FeedbackMessage": "uint8[16] goal_id\nint32[] sequence\n",
    "action_msgs/msg/GoalStatusArray": "action_msgs/GoalStatus[] status_list\n"
    + f"{_LINE}MSG: action_msgs/GoalStatus\naction_msgs/GoalInfo goal_info\nint8 status\n"
    + f"{_LINE}MSG: action_msgs/GoalInfo\nunique_identifier_msgs/UUID goal_id\nbuiltin_interfaces/Time stamp\n"
    + f"{_LINE}MSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n"
    + f"{_LINE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
}


@cache
def channel(type_name: str, ros: RosVersion = 2) -> Channel:
    """Return the knowledge of a machine with the standard types of a ROS about one of them."""
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)
    text, md5 = store.generate_msgdef(type_name, ros)
    digest = md5 if ros == 1 else type_hash(type_name, text, "msg")
    return Channel("", type_name, ros, hash=digest, definition=text, definition_format="msg")


def custom(type_name: str, text: str, ros: RosVersion = 2) -> Channel:
    """Return a type by its definition text."""
    return Channel(
        "",
        type_name,
        ros,
        hash=type_hash(type_name, text, "msg") if ros == 2 else "",
        definition=text,
        definition_format="msg",
    )


@cache
def channels(ros: RosVersion = 2) -> dict[str, Channel]:
    """Return the types that a machine knows by default."""
    known = {name: channel(name, ros) for name in (STRING, IMAGE, "std_msgs/msg/Int32")}
    if ros == 1:
        return known
    return known | {TRANSFORMS: channel(TRANSFORMS)} | {name: custom(name, text) for name, text in _TOPICS.items()}


def service(type_name: str, request: str, response: str, ros: RosVersion = 2) -> Service:
    """Return a service type by its definition texts."""
    halves = (
        Channel("", f"{type_name}_{half}", ros, hash="", definition=text, definition_format="msg")
        for half, text in (("Request", request), ("Response", response))
    )
    known = Service("", type_name, "", *halves)
    other: RosVersion = 2 if ros == 1 else 1
    return translated_service(translated_service(known, other), ros)


@cache
def services(ros: RosVersion = 2) -> dict[str, Service]:
    """Return the service types that a machine knows by default."""
    both = (SET_BOOL, TRIGGER)
    return {name: service(name, *texts, ros) for name, texts in _SERVICES.items() if ros == 2 or name in both}


def string(text: str, ros: RosVersion = 2) -> bytes:
    """Return a ``std_msgs/String``."""
    data = text.encode()
    return struct.pack("<I", len(data)) + data if ros == 1 else _CDR + struct.pack("<I", len(data) + 1) + data + b"\0"


def text_of(raw: bytes, ros: RosVersion = 2) -> str:
    """Return the text of a ``std_msgs/String``."""
    return raw[4:].decode() if ros == 1 else raw[8:].split(b"\0")[0].decode()


def switch(*, on: bool, ros: RosVersion = 2) -> bytes:
    """Return a request of ``std_srvs/SetBool``."""
    return bytes([on]) if ros == 1 else _CDR + bytes([on])


def switched(message: str, ros: RosVersion = 2) -> bytes:
    """Return a response of ``std_srvs/SetBool`` that says yes."""
    if ros == 1:
        return b"\1" + string(message, 1)
    return _CDR + b"\1\0\0\0" + string(message)[4:]


def image(pixels: bytes, ros: RosVersion = 2) -> bytes:
    """Return a ``sensor_msgs/Image`` of one row, from frame ``cam`` at 1.5 s."""
    if ros == 1:
        head = struct.pack("<IiiI3sIII4sBI", 0, 1, 500_000_000, 3, b"cam", 1, len(pixels), 4, b"mono", 0, len(pixels))
        return head + struct.pack("<I", len(pixels)) + pixels
    head = struct.pack("<iI I4s II I5s B2x I I", 1, 500_000_000, 4, b"cam\0", 1, len(pixels), 5, b"mono\0", 0, 0, 0)
    return _CDR + head[:-8] + struct.pack("<II", len(pixels), len(pixels)) + pixels
