"""Nodes of ROS 2's ``launch_ros``, and whole descriptions of its ``launch``, as what a plan says of them.

Place: shell; imports ROS 2's ``launch``. Its actions say what a node is only once substitutions are performed in a
context; a node of the cloud is asked that and never executed here.
Source: launch 3.4 and launch_ros 0.26 (jazzy).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from launch import LaunchContext, LaunchDescription
from launch.actions import ExecuteProcess
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.actions import Node

from fog.cluster import CloudNode
from fog.launch.cloud_node import parameter_rule, parameters_in
from fog.launch.load import RobotNode
from fog.launch.ros_action import FogCluster
from fog.launch.wish import Wish
from gdp.errors import LocalError

__all__ = ["cloud_node", "gathered"]

_MADE: Final = "launch_params_"  # by launch_ros for maps of parameters, and left behind


def gathered(
    description: object, arguments: Mapping[str, str]
) -> tuple[list[tuple[Wish, list[CloudNode]]], list[RobotNode]]:
    """Return the clusters of a description and the nodes of the robot's side, includes and groups followed.

    Raises:
        LocalError: something in it can only be run by ``ros2 launch``, or an argument is missing.
    """
    if not isinstance(description, LaunchDescription):
        raise LocalError(f"expected a LaunchDescription, not {type(description).__name__}")
    context = LaunchContext(noninteractive=True)
    context.launch_configurations.update(arguments)
    clusters: list[tuple[Wish, list[CloudNode]]] = []
    robot: list[RobotNode] = []
    waiting: list[object] = [description]
    while waiting:
        entity = waiting.pop(0)
        condition = getattr(entity, "condition", None)
        if condition is not None and not condition.evaluate(context):
            continue
        if isinstance(entity, FogCluster):
            clusters.append((entity.wish, [cloud_node(each, context) for each in entity.cloud_nodes]))
        elif isinstance(entity, Node):
            robot.append(RobotNode(cloud_node(entity, context), _output(entity, context)))
        elif isinstance(entity, ExecuteProcess):
            raise LocalError("the launch description starts a process that is no Node: run it with ros2 launch")
        else:
            waiting = [*_inside(entity, context), *waiting]
    return clusters, robot


def cloud_node(node: object, context: LaunchContext) -> CloudNode:
    """Return a node with all substitutions performed.

    Raises:
        LocalError: it is no node with a package, or one of its files of parameters cannot be used.
    """
    if not isinstance(node, Node) or node.node_package is None:
        raise LocalError(f"cloud_nodes: expected launch_ros.actions.Node with a package, not {type(node).__name__}")
    node._perform_substitutions(context)
    name = str(node.node_name).rpartition("/")[2]
    namespace = str(node.expanded_node_namespace or "")
    context.extend_locals({"ros_specific_arguments": {"name": f"__node:={name}", "ns": f"__ns:={namespace}"}})
    # The first word is the executable, for which this machine need not have the package.
    words = [str(perform_substitutions(context, word)) for word in node.cmd[1:]]
    package, executable = (
        str(perform_substitutions(context, normalize_to_list_of_substitutions(said)))
        for said in (node.node_package, node.node_executable)
    )
    environment = {
        str(perform_substitutions(context, key)): str(perform_substitutions(context, value))
        for key, value in node.additional_env or ()
    }
    is_named = not name.startswith("<") and not namespace.startswith("<")
    arguments = _without_files(words, name if is_named else None, namespace if is_named else None)
    return CloudNode(package, executable, tuple(arguments), environment)


def _without_files(words: Sequence[str], name: str | None, namespace: str | None) -> list[str]:
    kept: list[str] = []
    rest = iter(words)
    for word in rest:
        if word == "--params-file":
            path = Path(next(rest))
            is_made = path.name.startswith(_MADE) and path.parent == Path(tempfile.gettempdir())
            kept += parameters_in(path, name, namespace, has_tuples=is_made)
            if is_made:
                path.unlink()
        elif word == "-p":
            kept += [word, parameter_rule(next(rest))]
        else:
            kept.append(word)
    return [] if kept == ["--ros-args"] else kept


def _output(node: Node, context: LaunchContext) -> str:
    """Return where a node's standard output goes, ``screen`` or ``log``, as ``launch.logging`` reads it."""
    said = node.output
    if isinstance(said, dict):
        words = {*said.get("stdout", ()), *said.get("both", ())}
    else:
        words = {perform_substitutions(context, said)}
    return "screen" if words & {"screen", "both", "full"} else "log"


def _inside(entity: object, context: LaunchContext) -> Iterable[object]:
    try:
        return entity.visit(context) or ()  # type: ignore[attr-defined]
    except Exception as error:  # an action may do anything when visited
        raise LocalError(f"{type(entity).__name__}: {error}; does ros2 launch take it?") from error
