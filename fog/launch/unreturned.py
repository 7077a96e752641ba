"""Tracking of clusters that a launch file constructs and does not return, as in the paper's Listing 1.

I/O: reads the call stack and sets the class of a launch file's module. A watched launch file has a list of the clusters
constructed while it ran. When ``generate_launch_description`` returns, clusters without any reference are inserted into
the description, before the first entity that is not a setting.

Under ROS 2's launch, ``watch_ros_launch`` watches every launch file. It wraps the one function of launch 3.4 that runs
launch files. It also finds the launch file that runs at this moment, which is the one that imports ``fog``.
Source: FogROS2-FT, Listing 1; launch 3.4.3 ``python_launch_file_utilities.py``.
"""

from __future__ import annotations

import functools
import gc
import importlib
import sys
from collections.abc import Callable, Iterator
from types import FrameType, ModuleType
from typing import Final

from gdp.errors import LocalError

_ENTRY: Final = "generate_launch_description"
_MADE: Final = "__fog_clusters__"
_LOADER: Final = "launch.launch_description_sources.python_launch_file_utilities"
_LOAD: Final = "load_python_launch_file_as_module"
_SETTINGS: Final = {
    "AppendEnvironmentVariable",
    "DeclareLaunchArgument",
    "LogInfo",
    "PushRosNamespace",
    "SetEnvironmentVariable",
    "SetLaunchConfiguration",
    "SetParameter",
    "SetParametersFromFile",
    "SetRemap",
    "SetROSLogDir",
    "SetUseSimTime",
    "UnsetEnvironmentVariable",
    "UnsetLaunchConfiguration",
}


class LaunchFile(ModuleType):
    """Watched launch file: the description that its entry point returns contains the clusters that it constructed."""

    def _entry(self) -> object:
        if _ENTRY not in self.__dict__:
            raise AttributeError(f"module {self.__name__!r} has no attribute {_ENTRY!r}")
        entry = self.__dict__[_ENTRY]
        if not callable(entry):
            return entry

        def generate(*arguments: object, **keywords: object) -> object:
            description = entry(*arguments, **keywords)
            adopt(self, description)
            return description

        return generate

    generate_launch_description = property(_entry)


def watch(module: ModuleType) -> None:
    """Watch a launch file, before or while it runs; idempotent."""
    module.__dict__.setdefault(_MADE, [])
    if type(module) is ModuleType:
        module.__class__ = LaunchFile


def record(cluster: object) -> None:
    """Record a cluster for the launch file that constructs it; a cluster of any other code is not recorded.

    Raises:
        LocalError: ROS 2's launch is running a launch file that can no longer be watched.
    """
    for frame in _stack(sys._getframe(1)):
        if (made := frame.f_globals.get(_MADE)) is not None:
            made.append(cluster)
            return
        if frame.f_globals.get("__name__") == _LOADER:
            raise LocalError(
                "this launch file imports fog within a function, too late to see which FogClusters it returns:"
                " import fog at the top of the file"
            )


def adopt(module: ModuleType, description: object) -> None:
    """Insert unreferenced clusters of a launch file into its description, and stop watching the file."""
    made: list[object] = module.__dict__.pop(_MADE, [])
    if not hasattr(description, "entities"):
        return
    lost = [index for index in range(len(made)) if not _is_held(made[index], module, made)]
    entities = description.entities
    place = 0
    while place < len(entities) and type(entities[place]).__name__ in _SETTINGS:
        place += 1
    entities[place:place] = [made[index] for index in lost]


def watch_ros_launch() -> None:
    """Watch every Python launch file that ROS 2's launch runs from now on, and the one that runs now."""
    loader = importlib.import_module(_LOADER)
    load: Callable[[str], ModuleType] = getattr(loader, _LOAD)
    own: Callable[[str], ModuleType] = getattr(load, "__wrapped__", load)
    if load is own:

        @functools.wraps(own)
        def watched(python_launch_file_path: str) -> ModuleType:
            module = own(python_launch_file_path)
            watch(module)
            return module

        setattr(loader, _LOAD, watched)
    for frame in _stack(sys._getframe(1)):
        if frame.f_code is own.__code__:
            for value in frame.f_locals.values():
                if isinstance(value, ModuleType):
                    watch(value)


def _stack(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back


def _is_held(cluster: object, module: ModuleType, made: list[object]) -> bool:
    """Return whether something refers to it: the description, a group in it, the closure of an ``OpaqueFunction``.

    Variables of the launch file do not count: assigning a cluster to a variable does not launch it.
    """
    own = (id(made), id(module.__dict__))
    return any(id(each) not in own and not isinstance(each, FrameType) for each in gc.get_referrers(cluster))
