"""``Node`` of a launch file with ROS 2's ``launch_ros``: its own node, extended to Python modules.

I/O; imports ROS 2's ``launch``. ``package`` and ``executable`` have the same meaning as without ROS 2's launch: the
program of ``ros2 run``, else the Python module ``PACKAGE.EXECUTABLE`` (``resolve``).
Source: launch_ros 0.26.6 (jazzy): ``actions/node.py``.
"""

from __future__ import annotations

import os
import sys

import launch_ros.actions
from launch import LaunchContext, LaunchDescriptionEntity
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from fog.cluster import CloudNode
from fog.launch.resolve import PYTHON, command_line
from gdp.errors import LocalError


class Node(launch_ros.actions.Node):  # type: ignore[misc]  # launch_ros has no types
    """ROS node; see ``launch_ros.actions.Node``.

    Args:
        exec_name: label of its output; None: its executable, also while it waits for a cluster.
    """

    def __init__(self, *, executable: object, exec_name: object = None, **keywords: object) -> None:
        super().__init__(executable=executable, exec_name=executable if exec_name is None else exec_name, **keywords)

    def execute(self, context: LaunchContext) -> list[LaunchDescriptionEntity] | None:
        """Start the node.

        Raises:
            Exception: any error of launch_ros, such as for a package that is neither installed nor a module.
        """
        if self.node_package is not None:
            package, executable = (
                str(perform_substitutions(context, normalize_to_list_of_substitutions(said)))
                for said in (self.node_package, self.node_executable)
            )
            try:
                words = command_line(CloudNode(package, executable), os.environ)
            except LocalError:
                words = ()  # launch_ros reports the error
            if words[:1] == (PYTHON,):
                started = (sys.executable, *words[1:])
                self.cmd[:1] = [normalize_to_list_of_substitutions(word) for word in started]
        entities: list[LaunchDescriptionEntity] | None = super().execute(context)
        return entities
