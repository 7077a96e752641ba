"""The node action: its command line grows while substitutions are performed, and dictionaries become files."""

import tempfile

import yaml
from launch.actions import ExecuteProcess
from launch.substitutions import LocalSubstitution
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions


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
        parameters=None,
        remappings=None,
        ros_arguments=None,
        arguments=None,
        **rest,
    ):
        cmd = [["/nowhere/", executable], *(arguments or ()), "--ros-args", *(ros_arguments or ())]
        if name is not None:
            cmd += ["-r", LocalSubstitution("ros_specific_arguments['name']")]
        super().__init__(cmd=cmd, **rest)
        self.node_package, self.node_executable = package, executable
        self.said = (name, namespace, parameters or (), remappings or ())
        self.node_name = self.expanded_node_namespace = None

    def _perform_substitutions(self, context):
        name, namespace, parameters, remappings = self.said

        def text(said):
            return perform_substitutions(context, normalize_to_list_of_substitutions(said))

        own = self.UNSPECIFIED_NODE_NAME if name is None else text(name)
        self.expanded_node_namespace = self.UNSPECIFIED_NODE_NAMESPACE
        if namespace is not None:
            self.expanded_node_namespace = "/" + text(namespace).strip("/")
            self.cmd += [["-r"], [LocalSubstitution("ros_specific_arguments['ns']")]]
        self.node_name = f"{self.expanded_node_namespace}/{own}"
        for said in parameters:
            path = said
            if isinstance(said, dict):
                known = {key: text(value) if hasattr(value, "perform") else value for key, value in said.items()}
                with tempfile.NamedTemporaryFile("w", prefix="launch_params_", delete=False) as file:
                    path = file.name
                    yaml.dump({"/**": {"ros__parameters": known}}, file)
            self.cmd += [["--params-file"], [str(path)]]
        for old, new in remappings:
            self.cmd += [["-r"], [f"{text(old)}:={text(new)}"]]
