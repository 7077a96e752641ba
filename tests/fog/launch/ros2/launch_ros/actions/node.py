"""Node action: its command line grows while substitutions are performed, and dictionaries become files."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from launch.actions import ExecuteProcess
from launch.substitutions import LocalSubstitution
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

if TYPE_CHECKING:
    from launch import LaunchContext, LaunchDescriptionEntity
    from launch.utilities import Part


def _evaluated(context: LaunchContext, value: object) -> object:
    """Turn lists into tuples and read values of launch arguments as YAML, like launch_ros."""
    if isinstance(value, dict):
        return _evaluated_group(context, value)
    if isinstance(value, list | tuple):
        return tuple(_evaluated(context, each) for each in value)
    if hasattr(value, "perform"):
        return yaml.safe_load(perform_substitutions(context, [value]))
    return value


def _evaluated_group(context: LaunchContext, values: Mapping[str, object]) -> dict[str, object]:
    return {key: _evaluated(context, each) for key, each in values.items()}


def _flat(parameters: Mapping[str, object], group: str = "") -> dict[str, object]:
    """Turn groups into names with dots, like launch_ros."""
    found: dict[str, object] = {}
    for key, value in parameters.items():
        found |= _flat(value, f"{group}{key}.") if isinstance(value, dict) else {f"{group}{key}": value}
    return found


class Node(ExecuteProcess):  # type: ignore[misc]  # launch has no types
    UNSPECIFIED_NODE_NAME = "<node_name_unspecified>"
    UNSPECIFIED_NODE_NAMESPACE = "<node_namespace_unspecified>"

    def __init__(
        self,
        *,
        executable: Part | Iterable[Part],
        package: Part | Iterable[Part] | None = None,
        name: Part | Iterable[Part] | None = None,
        namespace: Part | Iterable[Part] | None = None,
        exec_name: Part | Iterable[Part] | None = None,
        parameters: Iterable[Mapping[str, object] | str | Path] | None = None,
        remappings: Iterable[tuple[Part, Part]] | None = None,
        ros_arguments: Iterable[Part] | None = None,
        arguments: Iterable[Part] | None = None,
        **rest: object,
    ) -> None:
        cmd = [["/nowhere/", executable], *(arguments or ())]
        cmd += [] if ros_arguments is None else ["--ros-args", *ros_arguments]
        cmd += ["--ros-args"]
        if name is not None:
            cmd += ["-r", LocalSubstitution("ros_specific_arguments['name']")]
        super().__init__(cmd=cmd, name=exec_name, **rest)
        self.node_package, self.node_executable = package, executable
        self._said = (name, namespace, parameters or (), remappings or ())
        self.node_name: str | None = None
        self.expanded_node_namespace = self.UNSPECIFIED_NODE_NAMESPACE

    def _perform_substitutions(self, context: LaunchContext) -> None:
        name, namespace, parameters, remappings = self._said

        def text(said: Part | Iterable[Part]) -> str:
            return str(perform_substitutions(context, normalize_to_list_of_substitutions(said)))

        own = self.UNSPECIFIED_NODE_NAME if name is None else text(name)
        if namespace is not None:
            self.expanded_node_namespace = "/" + text(namespace).strip("/")
            self.cmd.extend([["-r"], [LocalSubstitution("ros_specific_arguments['ns']")]])
        self.node_name = f"{self.expanded_node_namespace}/{own}"
        for said in parameters:
            if isinstance(said, str | Path):
                path = str(Path(said))
            else:
                is_named = "<" not in self.node_name
                known = {
                    self.node_name if is_named else "/**": {"ros__parameters": _flat(_evaluated_group(context, said))}
                }
                with tempfile.NamedTemporaryFile("w", prefix="launch_params_", delete=False) as file:
                    path = file.name
                    yaml.dump(known, file, default_flow_style=False)
            self.cmd.extend([["--params-file"], [path]])
        for old, new in remappings:
            self.cmd.extend([["-r"], [f"{text(old)}:={text(new)}"]])

    def execute(self, context: LaunchContext) -> Iterable[LaunchDescriptionEntity] | None:
        self._perform_substitutions(context)
        entities: Iterable[LaunchDescriptionEntity] | None = super().execute(context)
        return entities
