"""Elements of a launch file for hosts without ROS 2's ``launch`` and ``launch_ros``.

Sans-I/O. The names and keywords are those of ROS 2 that have a meaning here; any other keyword is refused.
Source: https://docs.ros.org/en/jazzy/Tutorials/Intermediate/Launch/Launch-Main.html.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from gdp.errors import LocalError


@dataclass(frozen=True, slots=True)
class LaunchConfiguration:
    """Value of a launch argument, substituted when the description is launched."""

    variable_name: str
    default: str | None = None


Text: TypeAlias = str | LaunchConfiguration | Sequence[str | LaunchConfiguration]
Parameters: TypeAlias = Mapping[str, object] | Text


@dataclass(frozen=True, slots=True)
class DeclareLaunchArgument:
    """Argument of a launch file, given as ``name:=value``.

    Args:
        default_value: None: the argument is required.
            choices: allowed values; None: any.
    """

    name: str
    default_value: str | None = None
    description: str = ""
    choices: Sequence[str] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """ROS node.

    Args:
        package, executable: as ``ros2 run`` takes them; without such an installed package, the Python module
            ``package.executable``.
        parameters: maps of values and paths of YAML files; later entries override earlier ones.
        remappings: pairs (from, to).
        arguments: after the executable, before ``--ros-args``.
        ros_arguments: after ``--ros-args``.
    """

    package: Text
    executable: Text
    name: Text | None = None
    namespace: Text | None = None
    parameters: Sequence[Parameters] = ()
    remappings: Sequence[tuple[Text, Text]] = ()
    arguments: Sequence[Text] = ()
    ros_arguments: Sequence[Text] = ()
    additional_env: Mapping[str, Text] = field(default_factory=dict)
    output: Literal["screen", "both", "log"] = "log"


class LaunchDescription:
    """Ordered list of launched entities."""

    def __init__(self, initial_entities: Iterable[object] = ()) -> None:
        self.entities: list[object] = list(initial_entities)

    def add_action(self, action: object) -> None:
        """Append an entity."""
        self.entities.append(action)


def written(text: Text, given: Mapping[str, str]) -> str:
    """Return a text with the launch arguments substituted."""
    if isinstance(text, str):
        return text
    if not isinstance(text, LaunchConfiguration):
        return "".join(written(part, given) for part in text)
    value = given.get(text.variable_name, text.default)
    if value is None:
        raise LocalError(f"launch argument {text.variable_name!r} is not given: add {text.variable_name}:=VALUE")
    return value
