"""Loader of launch files: the cluster of a file, and its nodes for the robot's side.

I/O; executes the file, which is Python, and starts no node.
"""

from __future__ import annotations

import difflib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Final, TypeAlias

from fog.cluster import CloudNode, ClusterPlan, ExportedInterface, RobotNode
from fog.launch.cloud_node import cloud_node
from fog.launch.cluster_spec import ClusterSpec
from fog.launch.description import DeclareLaunchArgument, LaunchDescription, Node
from fog.launch.entity import FogCluster
from fog.launch.lazy_names import has_ros_launch
from fog.launch.unreturned import watch
from gdp.errors import ConfigError, GdpError, LocalError

Probe: TypeAlias = Callable[[Sequence[CloudNode]], Sequence[tuple[str, str, str]]]

_ENTRY: Final = "generate_launch_description"


@dataclass(frozen=True, slots=True)
class Loaded:
    """Result of loading a launch file.

    Args:
        is_known: whether the plan contains the exported interfaces; otherwise they are still to be discovered.
    """

    plan: ClusterPlan
    robot_nodes: tuple[RobotNode, ...] = ()
    keep: bool = False
    notes: tuple[str, ...] = ()
    is_known: bool = True


def key_values(words: Sequence[str]) -> dict[str, str]:
    """Read launch arguments, ``name:=value`` each."""
    given: dict[str, str] = {}
    for word in words:
        key, separator, value = word.partition(":=")
        if not separator or not key or key in given:
            raise LocalError(f"{word!r}: expected launch arguments as name:=value, each once")
        given[key] = value
    return given


def load(path: Path, arguments: Mapping[str, str], probe: Probe | None = None) -> Loaded:
    """Run a launch file, or read a plan (``.json``).

    Args:
        probe: discovers interfaces (``fog.launch.interface_discovery.offered``) if the file lists none; None: no
            discovery.

    Raises:
        ConfigError: the file is missing, is not Python, or fails; the text names the line.
        LocalError: the description is invalid; the text states the reason.
    """
    if path.suffix == ".json":
        try:
            return Loaded(ClusterPlan.from_json(path.read_text(encoding="utf-8")), keep=True)
        except OSError as error:
            raise ConfigError(str(path), "", f"cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            line = error.object.count(b"\n", 0, error.start) + 1
            raise ConfigError(f"{path}:{line}", "", "UTF-8 text is expected") from error
        except LocalError as error:
            raise ConfigError(str(path), "", str(error)) from error
    description = _described(path)
    if has_ros_launch():
        from fog.launch.ros_description import gathered

        return _planned(*gathered(description, arguments), probe)
    return _planned(*_gathered(description, arguments), probe)


def _planned(
    clusters: Sequence[tuple[ClusterSpec, Sequence[CloudNode]]], robot: Sequence[RobotNode], probe: Probe | None
) -> Loaded:
    if len(clusters) != 1:
        raise LocalError(f"the launch description has {len(clusters)} FogClusters: expected one")
    cluster_spec, nodes = clusters[0]
    found: Sequence[ExportedInterface] = ()
    if cluster_spec.carried is None and probe is not None:
        cluster_spec.plan(nodes)  # raises before anything is started
        found = cluster_spec.carry(probe(nodes))
    is_known = cluster_spec.carried is not None or probe is not None
    return Loaded(cluster_spec.plan(nodes, found), tuple(robot), cluster_spec.keep, cluster_spec.notes, is_known)


def _gathered(
    description: object, arguments: Mapping[str, str]
) -> tuple[list[tuple[ClusterSpec, list[CloudNode]]], list[RobotNode]]:
    if not isinstance(description, LaunchDescription):
        raise LocalError(f"{_ENTRY} returned {type(description).__name__}: expected a LaunchDescription")
    given = _arguments(description.entities, arguments)
    clusters, robot = [], []
    for entity in description.entities:
        if isinstance(entity, FogCluster):
            clusters.append((entity.cluster_spec, [_node(each, given) for each in entity.cloud_nodes]))
        elif isinstance(entity, Node):
            robot.append(RobotNode(cloud_node(entity, given), entity.output))
        elif not isinstance(entity, DeclareLaunchArgument):
            raise LocalError(
                f"the launch description has a {type(entity).__name__}: expected FogCluster, Node or"
                " DeclareLaunchArgument; more is understood where ROS 2's launch and launch_ros are installed"
            )
    return clusters, robot


def _node(entity: object, given: Mapping[str, str]) -> CloudNode:
    if not isinstance(entity, Node):
        raise LocalError(f"cloud_nodes: expected Node, not {type(entity).__name__}")
    return cloud_node(entity, given)


def _arguments(entities: Sequence[object], given: Mapping[str, str]) -> dict[str, str]:
    declared = [entity for entity in entities if isinstance(entity, DeclareLaunchArgument)]
    if unknown := sorted(given.keys() - {each.name for each in declared}):
        known = ", ".join(each.name for each in declared) or "none"
        raise LocalError(f"launch argument {', '.join(unknown)}: not declared; declared: {known}")
    values = {each.name: each.default_value for each in declared if each.default_value is not None} | dict(given)
    for each in declared:
        value = values.get(each.name)
        if value is None:
            raise LocalError(f"launch argument {each.name!r} is not given: add {each.name}:=VALUE  {each.description}")
        if each.choices is not None and value not in each.choices:
            raise LocalError(f"launch argument {each.name}:={value}: expected {', '.join(each.choices)}")
    return values


def _described(path: Path) -> object:
    """Run the file and call its entry point."""
    try:
        module = _module(path)
        entry = getattr(module, _ENTRY, None)
        if not inspect.isfunction(entry):
            raise ConfigError(str(path), _ENTRY, "expected a function of this name that returns a LaunchDescription")
        described: object = entry()
    except ConfigError:
        raise
    except ModuleNotFoundError as error:
        advice = ""
        if str(error.name).partition(".")[0] in ("launch", "launch_ros"):
            advice = "; ROS 2's launch is not installed: say `from fog import LaunchDescription, Node` instead"
        raise ConfigError(_place(path, error), "", f"{error}{advice}") from error
    except GdpError as error:
        raise ConfigError(_place(path, error), "", str(error)) from error
    except (Exception, SystemExit) as error:  # any error of the user's code is reported with its line
        raise ConfigError(_place(path, error), "", f"{type(error).__name__}: {error}{_near_word(error)}") from error
    return described


def _near_word(error: BaseException) -> str:
    """Return the argument of ``FogCluster`` that an unknown one may mean."""
    found = re.search(r"FogCluster.*unexpected keyword argument '(\w+)'", str(error))
    known = inspect.signature(FogCluster).parameters
    near = difflib.get_close_matches(found[1], known, 1) if found is not None else []
    return f"; did you mean {near[0]}?" if near else ""


def _module(path: Path) -> ModuleType:
    if not path.is_file():
        raise ConfigError(str(path), "", "no such launch file")
    spec = importlib.util.spec_from_file_location("fog_launch_file", path)
    if spec is None or spec.loader is None:
        raise ConfigError(str(path), "", "expected a Python launch file (.py), or a plan (.json)")
    module = importlib.util.module_from_spec(spec)
    watch(module)
    folder = str(path.resolve().parent)
    sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(folder)
    return module


def _place(path: Path, error: BaseException) -> str:
    """Return ``file:line`` of the last launch-file line in the error's traceback."""
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).resolve() == path.resolve():
        return f"{path}:{error.lineno}"
    whole = path.resolve()  # the importer makes the name absolute
    lines = [at.lineno for at in traceback.extract_tb(error.__traceback__) if Path(at.filename).resolve() == whole]
    return f"{path}:{lines[-1]}" if lines else str(path)
