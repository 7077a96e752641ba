"""Definitions from generated classes, compared with ROS 2's own: the hashes next to the installed interfaces."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from gdp.errors import LocalError
from proxy.endpoints.definition import definition_of, interface_of, type_hash_of
from proxy.endpoints.ros2.types import channel_of, class_of, service_of
from proxy.serial.schema import parse
from proxy.serial.standard_types import type_hash
from tests.proxy.endpoints.ros2_net import needs

needs("std_msgs", "sensor_msgs", "nav_msgs", "std_srvs", "test_msgs")

SHARE = Path(sys.prefix) / "share"  # location of the wheels' files that a ROS installation has below its own prefix
PACKAGES = ("std_msgs", "sensor_msgs", "nav_msgs", "geometry_msgs", "std_srvs", "test_msgs", "action_msgs")


def hashes_of(package: str) -> dict[str, str]:
    """Return the hashes that rosidl wrote when it generated the package; actions have no class with fields."""
    files = sorted((SHARE / package).glob("*/*.json"))
    if not files:
        pytest.skip(f"the descriptions of {package} are not below {SHARE}")
    known = [entry for file in files for entry in json.loads(file.read_text()).get("type_hashes", ())]
    found = {entry["type_name"]: entry["hash_string"] for entry in known}
    return {name: digest for name, digest in found.items() if not name.endswith(("action/Fibonacci", "/NestedMessage"))}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_type_has_the_hash_that_rosidl_gave_it(package: str) -> None:
    wrong = [
        name for name, digest in hashes_of(package).items() if type_hash_of(interface_of(name, class_of)) != digest
    ]
    assert wrong == []


@pytest.mark.parametrize("package", PACKAGES)
def test_every_definition_text_can_be_read_and_means_the_same(package: str) -> None:
    for name, digest in hashes_of(package).items():
        if "/msg/" in name:
            text = definition_of(interface_of(name, class_of))
            # rosbags knows no hash of wide strings, and no text without fields
            assert not text or "wstring" in text or type_hash(name, text, "msg") == digest, name
            if text:
                parse(name, text, "msg", 2)


def test_used_types_follow_after_a_rule() -> None:
    text = definition_of(interface_of("std_msgs/msg/Header", class_of))
    assert text == (
        f"builtin_interfaces/Time stamp\nstring frame_id\n{'=' * 80}\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )


def test_bounds_and_arrays_are_written_as_msg_files_do() -> None:
    text = definition_of(interface_of("test_msgs/msg/BoundedSequences", class_of))
    assert "byte[<=3] byte_values\n" in text
    assert "float64[<=3] float64_values\n" in text
    assert "uint8[<=3] char_values\n" in text
    assert "wstring[3] array_of_wstrings\n" in definition_of(interface_of("test_msgs/msg/WStrings", class_of))


def test_both_halves_of_services_and_parts_of_actions_are_described() -> None:
    service = service_of("/fib/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal")
    assert service.request.type_name == "test_msgs/action/Fibonacci_SendGoal_Request"
    assert service.request.definition.startswith("unique_identifier_msgs/UUID goal_id\ntest_msgs/action/Fibonacci_Goal")
    for half in (service.request, service.response, service_of("/s", "std_srvs/srv/SetBool").response):
        parse(half.type_name, half.definition, half.definition_format, half.ros)
    assert service.hash == hashes_of("test_msgs")["test_msgs/action/Fibonacci_SendGoal"]


def test_a_type_without_fields_has_a_definition_without_text_and_a_hash() -> None:
    channel = channel_of("/empty", "std_msgs/msg/Empty")
    assert (channel.definition, channel.definition_format) == ("", "msg")
    assert channel.hash == hashes_of("std_msgs")["std_msgs/msg/Empty"]


def test_a_class_that_says_nothing_is_refused() -> None:
    with pytest.raises(LocalError, match="does not say what its fields are"):
        interface_of("test_msgs/action/Fibonacci", class_of)
