"""Messages as YAML and JSON, and requests from YAML."""

from __future__ import annotations

import math

import orjson
import pytest
import yaml

from gdp.errors import LocalError, RemoteError
from proxy.serial.standard_types import known_channel
from proxy.tools.message_text import MessageText, request_of, request_tree


def raw_of(type_name: str, tree: object) -> bytes:
    """Return the CDR of a message."""
    return request_of(known_channel("/t", type_name), tree)


def test_yaml_has_the_fields_in_the_order_of_the_definition() -> None:
    raw = raw_of("geometry_msgs/msg/Vector3", {"z": 3.5, "x": 1})
    assert MessageText(known_channel("/t", "geometry_msgs/msg/Vector3")).to_yaml(raw) == "x: 1.0\ny: 0.0\nz: 3.5\n"


def test_octets_are_a_list_in_yaml_and_base64_in_json() -> None:
    raw = raw_of("sensor_msgs/msg/CompressedImage", {"format": "png", "data": [1, 2, 255]})
    text = MessageText(known_channel("/t", "sensor_msgs/msg/CompressedImage"))
    assert yaml.safe_load(text.to_yaml(raw))["data"] == [1, 2, 255]
    assert orjson.loads(orjson.dumps(text.to_json(raw)))["data"] == "AQL/"


def test_numbers_without_a_form_in_json_are_whole_in_yaml() -> None:
    raw = raw_of("sensor_msgs/msg/LaserScan", {"ranges": [1.5, None], "angle_min": None})
    text = MessageText(known_channel("/t", "sensor_msgs/msg/LaserScan"))
    shown = yaml.safe_load(text.to_yaml(raw))
    assert shown["ranges"][0] == 1.5
    assert math.isnan(shown["ranges"][1])
    assert math.isnan(shown["angle_min"])
    assert orjson.loads(orjson.dumps(text.to_json(raw)))["ranges"] == [1.5, None]


def test_long_arrays_and_strings_are_cut_in_yaml_only() -> None:
    raw = raw_of("sensor_msgs/msg/CompressedImage", {"format": "f" * 300, "data": list(range(200))})
    channel = known_channel("/t", "sensor_msgs/msg/CompressedImage")
    shown = yaml.safe_load(MessageText(channel, 10).to_yaml(raw))
    assert (shown["format"], shown["data"][-1], len(shown["data"])) == ("f" * 10 + "...", "...", 11)
    whole = yaml.safe_load(MessageText(channel, None).to_yaml(raw))
    assert (len(whole["format"]), len(whole["data"])) == (300, 200)


def test_a_message_that_does_not_fit_is_refused() -> None:
    text = MessageText(known_channel("/t", "geometry_msgs/msg/Vector3"))
    with pytest.raises(RemoteError):
        text.to_yaml(b"\0\1\0\0abc")


def test_a_type_without_fields_is_an_empty_mapping() -> None:
    raw = raw_of("std_msgs/msg/Empty", request_tree(""))
    assert MessageText(known_channel("/t", "std_msgs/msg/Empty")).to_yaml(raw) == "{}\n"


@pytest.mark.parametrize(
    ("text", "reason"), [("{a:", "no YAML"), ("[1]", "no YAML mapping"), ("a:1", "no YAML mapping")]
)
def test_a_request_that_is_no_mapping_is_refused(text: str, reason: str) -> None:
    with pytest.raises(LocalError, match=reason):
        request_tree(text)


def test_a_request_with_an_unknown_field_names_the_known_ones() -> None:
    with pytest.raises(LocalError, match="there is no field w; it has x, y, z"):
        request_of(known_channel("/t", "geometry_msgs/msg/Vector3"), {"w": 1})
