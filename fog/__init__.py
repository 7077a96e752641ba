"""Replicated ROS services on cloud machines: launch descriptions, providers, the supervisor and prices.

``from fog import FogCluster, SpotMachine`` loads a name when it is first used (docs/reference/launch-files.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fog.launch.description import DeclareLaunchArgument, LaunchConfiguration, LaunchDescription, Node
    from fog.launch.entity import FogCluster
    from fog.launch.machines import CloudMachine, SpotMachine

__all__ = [
    "CloudMachine",
    "DeclareLaunchArgument",
    "FogCluster",
    "LaunchConfiguration",
    "LaunchDescription",
    "Node",
    "SpotMachine",
]


def __getattr__(name: str) -> object:
    from fog.launch.lazy_names import word
    from gdp.extras import require_extra

    require_extra("fog", ("numpy", "rich", "rosbags"), "fog")
    return word(name)
