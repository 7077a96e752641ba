"""Adapter from nodes of ROS 2's ``launch_ros`` to the nodes of a plan.

I/O; imports ROS 2's ``launch``. Its actions describe a node only after substitutions are performed in a context.
The adapter performs them for a cloud node and never executes the node here.
Source: launch 3.4 and launch_ros 0.26 (jazzy).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from launch import LaunchContext
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.actions import Node

from fog.cluster import CloudNode
from fog.launch.cloud_node import parameter_rule, parameters_in
from gdp.errors import LocalError

_MADE: Final = "launch_params_"  # prefix of files that launch_ros creates for maps of parameters and does not delete


def cloud_node(node: object, context: LaunchContext) -> CloudNode:
    """Return a node with all substitutions performed."""
    if not isinstance(node, Node) or node.node_package is None:
        raise LocalError(f"cloud_nodes: expected launch_ros.actions.Node with a package, not {type(node).__name__}")
    node._perform_substitutions(context)
    name = str(node.node_name).rpartition("/")[2]
    namespace = str(node.expanded_node_namespace or "")
    context.extend_locals({"ros_specific_arguments": {"name": f"__node:={name}", "ns": f"__ns:={namespace}"}})
    # The first word is the executable; this machine need not have its package.
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
