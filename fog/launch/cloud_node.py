"""Conversion of a launch file's ``Node`` to the ``CloudNode`` of a plan.

I/O; reads parameter files, which the machines do not have.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, cast

from fog.cluster import CloudNode
from fog.launch.description import LaunchConfiguration, Node, Parameters, Text, written
from fog.launch.parameter_yaml import BYTES_MAX, read_parameters
from fog.launch.ros_args import named, parameters_of_file, parameters_of_map, remapped
from gdp.errors import LocalError
from gdp.stores.files import read_at_most

_TUPLE: Final = "!!python/tuple"


def cloud_node(node: Node, given: Mapping[str, str]) -> CloudNode:
    """Return a node with the launch arguments substituted."""
    name = None if node.name is None else written(node.name, given)
    namespace = None if node.namespace is None else written(node.namespace, given)
    ros = [written(each, given) for each in node.ros_arguments]
    ros += named(name, namespace)
    for parameters in node.parameters:
        ros += _parameters(parameters, given, name, namespace)
    ros += remapped((written(old, given), written(new, given)) for old, new in node.remappings)
    arguments = [written(each, given) for each in node.arguments]
    return CloudNode(
        written(node.package, given),
        written(node.executable, given),
        (*arguments, "--ros-args", *ros) if ros else tuple(arguments),
        {key: written(value, given) for key, value in node.additional_env.items()},
    )


def parameters_in(path: Path, name: str | None, namespace: str | None, *, has_tuples: bool = False) -> list[str]:
    """Return the command-line arguments that set a node's parameters from a parameter file.

    Args:
        has_tuples: launch_ros wrote the file; it writes every list as a tuple.
    """
    try:
        with path.open("rb") as file:
            raw = read_at_most(file, BYTES_MAX)
    except OSError as error:
        raise LocalError(f"parameters: {path}: {error.strerror}") from error
    try:
        text = raw.decode()
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise LocalError(f"parameters: {path}:{line}: UTF-8 text is expected") from error
    document = read_parameters(text, f"parameters: {path}", has_tuples=has_tuples)
    return parameters_of_file(document, str(path), name, namespace)


def parameter_rule(rule: str) -> str:
    """Return ``name:=value`` in the form that a node reads; launch_ros writes lists as tuples."""
    key, _, value = rule.partition(":=")
    if _TUPLE not in value:
        return rule
    (_, rule) = parameters_of_map({key: read_parameters(value, f"parameter {key}", has_tuples=True)})
    return rule


def _parameters(said: Parameters, given: Mapping[str, str], name: str | None, namespace: str | None) -> list[str]:
    if isinstance(said, Mapping):
        return parameters_of_map(_put_in(said, given))
    return parameters_in(Path(written(said, given)), name, namespace)


def _put_in(parameters: Mapping[str, object], given: Mapping[str, str]) -> dict[str, object]:
    """Substitute launch arguments in values; values of the command line are parsed as YAML, as ROS 2 does."""
    values: dict[str, object] = {}
    for key, value in parameters.items():
        if isinstance(value, Mapping):
            values[key] = _put_in(value, given)
        elif isinstance(value, LaunchConfiguration) or _has_argument(value):
            values[key] = read_parameters(written(cast("Text", value), given), f"parameter {key}")
        else:
            values[key] = value
    return values


def _has_argument(value: object) -> bool:
    return isinstance(value, list | tuple) and any(isinstance(each, LaunchConfiguration) for each in value)
