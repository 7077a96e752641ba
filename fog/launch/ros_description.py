"""Conversion of ROS 2 launch descriptions to clusters and nodes of the robot's side.

I/O; imports ROS 2's ``launch``. Conditions are evaluated, includes and groups are followed; no process is started.
Source: launch 3.4 and launch_ros 0.26 (jazzy).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from launch import LaunchContext, LaunchDescription
from launch.actions import ExecuteProcess
from launch.utilities import perform_substitutions
from launch_ros.actions import Node

from fog.cluster import CloudNode, RobotNode
from fog.launch.cluster_spec import ClusterSpec
from fog.launch.ros_action import FogCluster, cloud_node
from gdp.errors import LocalError


def gathered(
    description: object, arguments: Mapping[str, str]
) -> tuple[list[tuple[ClusterSpec, list[CloudNode]]], list[RobotNode]]:
    """Return the clusters of a description and the nodes of the robot's side, includes and groups followed."""
    if not isinstance(description, LaunchDescription):
        raise LocalError(f"expected a LaunchDescription, not {type(description).__name__}")
    context = LaunchContext(noninteractive=True)
    context.launch_configurations.update(arguments)
    clusters: list[tuple[ClusterSpec, list[CloudNode]]] = []
    robot: list[RobotNode] = []
    waiting: list[object] = [description]
    while waiting:
        entity = waiting.pop(0)
        condition = getattr(entity, "condition", None)
        if condition is not None and not condition.evaluate(context):
            continue
        if isinstance(entity, FogCluster):
            clusters.append((entity.cluster_spec, [cloud_node(each, context) for each in entity.cloud_nodes]))
        elif isinstance(entity, Node):
            robot.append(RobotNode(cloud_node(entity, context), _output(entity, context)))
        elif isinstance(entity, ExecuteProcess):
            raise LocalError("the launch description starts a process that is no Node: run it with ros2 launch")
        else:
            waiting = [*_inside(entity, context), *waiting]
    return clusters, robot


def _output(node: Node, context: LaunchContext) -> str:
    """Return the destination of a node's standard output, ``screen`` or ``log``, as in ``launch.logging``."""
    said = node.output
    if isinstance(said, dict):
        words = {*said.get("stdout", ()), *said.get("both", ())}
    else:
        words = {perform_substitutions(context, said)}
    return "screen" if words & {"screen", "both", "full"} else "log"


def _inside(entity: object, context: LaunchContext) -> Iterable[object]:
    try:
        return entity.visit(context) or ()  # type: ignore[attr-defined]
    except Exception as error:  # visiting an action may raise any error
        raise LocalError(f"{type(entity).__name__}: {error}; does ros2 launch take it?") from error
