"""Node action: its command line grows while substitutions are performed, and dictionaries become files."""

import tempfile
from pathlib import Path

import yaml
from launch.actions import ExecuteProcess
from launch.substitutions import LocalSubstitution
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions


def _evaluated(context, value):
    """Turn lists into tuples and read values of launch arguments as YAML, like launch_ros."""
    if isinstance(value, dict):
        return {key: _evaluated(context, each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return tuple(_evaluated(context, each) for each in value)
    if hasattr(value, "perform"):
        return yaml.safe_load(perform_substitutions(context, [value]))
    return value


def _flat(parameters, group=""):
    """Turn groups into names with dots, like launch_ros."""
    found = {}
    for key, value in parameters.items():
        found |= _flat(value, f"{group}{key}.") if isinstance(value, dict) else {f"{group}{key}": value}
    return found


class Node(ExecuteProcess):
    UNSPECIFIED_NODE_NAME = "<node_name_unspecified>"
    UNSPECIFIED_NODE_NAMESPACE = "<node_namespace_unspecified>"

    def __init__(
        self,
        *,
        executable,
        package=None,
        name=None,
        namespace=None,
        exec_name=None,
        parameters=None,
        remappings=None,
        ros_arguments=None,
        arguments=None,
        **rest,
    ):
        cmd = [["/nowhere/", executable], *(arguments or ())]
        cmd += [] if ros_arguments is None else ["--ros-args", *ros_arguments]
        cmd += ["--ros-args"]
        if name is not None:
            cmd += ["-r", LocalSubstitution("ros_specific_arguments['name']")]
        super().__init__(cmd=cmd, name=exec_name, **rest)
        self.node_package, self.node_executable = package, executable
        self._said = (name, namespace, parameters or (), remappings or ())
        self.node_name = None
        self.expanded_node_namespace = self.UNSPECIFIED_NODE_NAMESPACE

    def _perform_substitutions(self, context):
        name, namespace, parameters, remappings = self._said

        def text(said):
            return perform_substitutions(context, normalize_to_list_of_substitutions(said))

        own = self.UNSPECIFIED_NODE_NAME if name is None else text(name)
        if namespace is not None:
            self.expanded_node_namespace = "/" + text(namespace).strip("/")
            self.cmd.extend([["-r"], [LocalSubstitution("ros_specific_arguments['ns']")]])
        self.node_name = f"{self.expanded_node_namespace}/{own}"
        for said in parameters:
            path = said
            if isinstance(said, dict):
                is_named = "<" not in self.node_name
                known = {self.node_name if is_named else "/**": {"ros__parameters": _flat(_evaluated(context, said))}}
                with tempfile.NamedTemporaryFile("w", prefix="launch_params_", delete=False) as file:
                    path = file.name
                    yaml.dump(known, file, default_flow_style=False)
            self.cmd.extend([["--params-file"], [str(Path(path))]])
        for old, new in remappings:
            self.cmd.extend([["-r"], [f"{text(old)}:={text(new)}"]])

    def execute(self, context):
        self._perform_substitutions(context)
        return super().execute(context)
