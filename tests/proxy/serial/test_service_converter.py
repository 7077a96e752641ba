"""Service converter between ROS 1 and ROS 2, and the MD5 sums of installed types."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from gdp.errors import RemoteError
from proxy.serial.channel import Channel, RosVersion, Service
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.schema import DefinitionError
from proxy.serial.service_converter import translated_service

LITTLE = b"\x00\x01\x00\x00"
SET_BOOL = "09fb03525b03e7ea1fd3992bafd87e16"
INTERPRETER = Path("/usr/bin/python3")  # Debian's path of ROS 1

# Prints the types of the installed ROS 1: {type: [md5, text]} and {type: [md5, request text, response text]}.
LIST = """
import importlib, inspect, json
found = {"msg": {}, "srv": {}}
for package in "std_msgs std_srvs sensor_msgs geometry_msgs nav_msgs tf2_msgs rosgraph_msgs actionlib_msgs".split():
    for part in found:
        try:
            module = importlib.import_module(package + "." + part)
        except ImportError:
            continue
        for _, one in inspect.getmembers(module, inspect.isclass):
            if hasattr(one, "_request_class"):
                halves = [one._request_class._full_text, one._response_class._full_text]
                found["srv"][one._type] = [one._md5sum, *halves]
            elif part == "msg":
                found["msg"][one._type] = [one._md5sum, one._full_text]
print(json.dumps(found))
"""


@cache
def installed_ros1() -> dict[str, dict[str, list[str]]]:
    if not INTERPRETER.exists():
        pytest.skip("there is no Python of the system, so no ROS 1")
    done = subprocess.run([INTERPRETER, "-c", LIST], capture_output=True, text=True, check=False)
    found: dict[str, dict[str, list[str]]] = json.loads(done.stdout) if not done.returncode else {"srv": {}}
    if "std_srvs/SetBool" not in found["srv"]:
        pytest.skip("ROS 1 is not installed (scripts/setup_ros1.sh)")
    return found


@cache
def installed_ros2_hashes() -> dict[str, str]:
    hashes: dict[str, str] = {}
    for path in (Path(sys.prefix) / "share").glob("*_*/*/*.json"):
        for known in json.loads(path.read_text()).get("type_hashes", []):
            hashes[known["type_name"]] = known["hash_string"]
    if "std_srvs/srv/SetBool" not in hashes:
        pytest.skip("no ROS 2 wheels are installed in this environment")
    return hashes


def service(type_name: str, request: str, response: str, ros: RosVersion = 1, digest: str = "") -> Service:
    halves = (
        Channel("/s", f"{type_name}_{half}", ros, hash="", definition=text, definition_format="msg")
        for half, text in (("Request", request), ("Response", response))
    )
    return Service("/s", type_name, digest, *halves)


def ros1_services() -> list[Service]:
    found = installed_ros1()["srv"].items()
    return [service(name.replace("/", "/srv/"), one, other, 1, md5) for name, (md5, one, other) in found]


def test_a_service_there_and_back_has_its_ros_1_md5() -> None:
    before = service("std_srvs/srv/SetBool", "bool data\n", "bool success\nstring message\n", digest=SET_BOOL)
    after = translated_service(translated_service(before, 2), 1)
    assert after.hash == SET_BOOL
    assert (after.name, after.type_name, after.ros) == (before.name, before.type_name, 1)
    assert after.request.type_name == "std_srvs/srv/SetBool_Request"


def test_every_installed_ros_1_service_has_its_md5() -> None:
    for before in ros1_services():
        assert translated_service(translated_service(before, 2), 1).hash == before.hash, before.type_name


def test_every_installed_ros_1_message_has_its_md5() -> None:
    for name, (md5, text) in installed_ros1()["msg"].items():
        before = Channel("/t", name.replace("/", "/msg/"), 1, hash=md5, definition=text, definition_format="msg")
        assert translated_channel(translated_channel(before, 2), 1).hash == md5, name


def test_ros_1_services_have_the_hashes_of_the_ros_2_services_installed() -> None:
    compared = 0
    for before in ros1_services():
        after = translated_service(before, 2)
        for name, digest in ((after.type_name, after.hash), (after.request.type_name, after.request.hash)):
            if name in installed_ros2_hashes():
                assert digest == installed_ros2_hashes()[name], name
                compared += 1
    assert compared >= 16


def test_ros_1_messages_have_the_hashes_of_the_ros_2_messages_installed() -> None:
    compared = 0
    for name, (md5, text) in installed_ros1()["msg"].items():
        type_name = name.replace("/", "/msg/")
        if type_name not in installed_ros2_hashes() or name == "sensor_msgs/Range":  # Iron added ``variance``
            continue
        converter = translated_channel(
            Channel("/t", type_name, 1, hash=md5, definition=text, definition_format="msg"), 2
        )
        assert converter.hash == installed_ros2_hashes()[type_name], name
        compared += 1
    assert compared > 80


def test_a_ros_2_client_calls_a_ros_1_server() -> None:
    server = service("std_srvs/srv/SetBool", "bool data\n", "bool success\nstring message\n")
    client = translated_service(server, 2)
    request = MessageConverter(client.request, server.request)
    response = MessageConverter(server.response, client.response)
    assert request.convert(LITTLE + b"\x01") == b"\x01"
    assert response.convert(b"\x01" + struct.pack("<I", 2) + b"on") == LITTLE + b"\1\0\0\0\3\0\0\0on\0"
    with pytest.raises(RemoteError):
        request.convert(LITTLE)


def test_a_ros_1_client_calls_a_ros_2_server_with_an_empty_request() -> None:
    server = service("std_srvs/srv/Trigger", "", "bool success\nstring message\n", ros=2)
    client = translated_service(server, 1)
    request = MessageConverter(client.request, server.request)
    response = MessageConverter(server.response, client.response)
    assert request.convert(b"") == LITTLE + b"\0"
    assert response.convert(LITTLE + b"\1\0\0\0\1\0\0\0\0") == b"\1" + bytes(4)


def test_services_that_differ_are_refused_with_the_field() -> None:
    one = service("a/srv/B", "int32 x\n", "int32 y\n")
    other = service("a/srv/B", "int32 x\n", "int64 y\n", ros=2)
    with pytest.raises(DefinitionError, match="y: int64 there, int32 here"):
        MessageConverter(other.response, one.response)


def test_a_half_may_use_other_types() -> None:
    rule = "=" * 80 + "\n"
    text = f"geometry_msgs/Point[] points\nOwn own\n{rule}MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    before = service("a/srv/B", f"{text}{rule}MSG: a/Own\ntime stamp\n", "")
    after = translated_service(before, 2)
    assert "builtin_interfaces/Time stamp" in after.request.definition
    raw = struct.pack("<I3dII", 1, 1, 2, 3, 4, 5)
    assert MessageConverter(before.request, after.request).convert(raw) == LITTLE + struct.pack(
        "<I4x3dII", 1, 1, 2, 3, 4, 5
    )


def test_in_its_own_ros_a_service_needs_no_translation() -> None:
    about = service("a/srv/B", "", "")
    assert translated_service(about, 1) is about
