"""Standard types of both ROS versions: definitions and hashes."""

from __future__ import annotations

from proxy.serial.standard_types import standard_definition, type_hash


def test_a_type_of_humble_has_its_definition() -> None:
    definition = standard_definition("std_msgs/msg/Header")
    assert definition is not None
    assert "string frame_id" in definition
    assert standard_definition("unknown/msg/Type") is None


def test_the_hash_is_the_one_that_ros_2_publishes() -> None:
    # ros2 topic info -v /chatter
    published = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert type_hash("std_msgs/msg/String", "string data\n", "msg") == published


def test_a_definition_that_gives_no_hash_gives_an_empty_one() -> None:
    assert type_hash("a/msg/B", "C c\n", "msg") == ""
    assert type_hash("a/msg/B", "", "") == ""
