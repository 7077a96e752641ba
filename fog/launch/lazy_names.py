"""Lazily loaded names for launch files: ROS 2's if ``launch`` and ``launch_ros`` are installed, else those of ``fog``.

I/O; finds packages and imports a requested name. PyPI's ``launch`` is an unrelated project, so a package of that
name counts only if it contains ROS 2's files.
"""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from typing import Final

_OWN: Final = {"CloudMachine": "fog.launch.machines", "SpotMachine": "fog.launch.machines"}
_EITHER: Final = {  # name -> location in ``fog``, location in ROS 2
    "DeclareLaunchArgument": ("fog.launch.description", "launch.actions"),
    "FogCluster": ("fog.launch.entity", "fog.launch.ros_action"),
    "LaunchConfiguration": ("fog.launch.description", "launch.substitutions"),
    "LaunchDescription": ("fog.launch.description", "launch"),
    "Node": ("fog.launch.description", "fog.launch.ros_node"),
}
_FILES: Final = {"launch": "launch_description.py", "launch_ros": "actions/node.py"}

WORDS: Final = sorted({*_OWN, *_EITHER})


def has_ros_launch() -> bool:
    """Return whether ROS 2's ``launch`` and ``launch_ros`` are installed; imports neither."""
    return all(map(_has, _FILES))


def word(name: str) -> object:
    """Return the object for a name of ``WORDS``. Raises ``AttributeError``: the name is not in ``WORDS``."""
    if name in _OWN:
        module = _OWN[name]
    elif name in _EITHER:
        module = _EITHER[name][has_ros_launch()]
    else:
        raise AttributeError(f"module 'fog' has no attribute {name!r}")
    found: object = getattr(importlib.import_module(module), name)
    return found


def _has(package: str) -> bool:
    spec = importlib.util.find_spec(package)
    places = spec.submodule_search_locations if spec else None
    return any((Path(place) / _FILES[package]).is_file() for place in places or ())
