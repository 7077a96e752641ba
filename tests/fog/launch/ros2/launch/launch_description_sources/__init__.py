"""Sources of launch descriptions."""

from launch.launch_description_sources.python_launch_file_utilities import (
    get_launch_description_from_python_launch_file,
)
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions


class PythonLaunchDescriptionSource:
    def __init__(self, launch_file_path):
        self._path = launch_file_path

    def get_launch_description(self, context):
        path = perform_substitutions(context, normalize_to_list_of_substitutions(self._path))
        return get_launch_description_from_python_launch_file(path)
