"""ROS arguments of a node: parameters and remappings as command-line words."""

import math

import pytest

from fog.launch.ros_args import parameters_of_file, parameters_of_map
from gdp.errors import LocalError

FILE = {
    "/**": {"ros__parameters": {"all": 1}},
    "detector": {"ros__parameters": {"size": 640}},
    "far": {"detector": {"ros__parameters": {"size": 320}}},
}


def test_groups_of_parameters_are_joined_with_dots() -> None:
    words = parameters_of_map({"camera": {"rate": 30.0, "name": 'the "left" one'}, "flags": [True, False]})
    assert words == [
        *("-p", "camera.rate:=30.0"),
        *("-p", r'camera.name:="the \"left\" one"'),
        *("-p", "flags:=[true, false]"),
    ]


def test_numbers_that_are_none_are_written_as_yaml_writes_them() -> None:
    assert parameters_of_map({"a": math.inf, "b": math.nan})[1::2] == ["a:=.inf", "b:=.nan"]


def test_a_value_that_no_parameter_has_is_refused() -> None:
    with pytest.raises(LocalError, match="parameter a: None"):
        parameters_of_map({"a": None})


@pytest.mark.parametrize(
    ("name", "namespace", "words"),
    [
        ("detector", None, ["-p", "all:=1", "-p", "size:=640"]),
        ("detector", "far", ["-p", "all:=1", "-p", "size:=320"]),
        ("other", None, ["-p", "all:=1"]),
    ],
)
def test_a_node_takes_its_own_sections_of_a_file(name: str, namespace: str | None, words: list[str]) -> None:
    assert parameters_of_file(FILE, "params.yaml", name, namespace) == words


def test_without_a_name_the_node_itself_picks_its_section() -> None:
    document = {"detector": {"ros__parameters": {"size": 640}}}
    assert parameters_of_file(document, "params.yaml", None, None) == ["-p", "detector:size:=640"]


@pytest.mark.parametrize(
    ("document", "says"),
    [
        (FILE, "section far/detector: cannot be used here: name the node"),
        (["size"], "expected nodes"),
        ({"ros__parameters": {"size": 1}}, "within a node"),
        ({"detector": {"size": 640}}, "detector/size: expected nodes"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(document: object, says: str) -> None:
    with pytest.raises(LocalError, match=rf"params.yaml: .*{says}"):
        parameters_of_file(document, "params.yaml", None, None)
