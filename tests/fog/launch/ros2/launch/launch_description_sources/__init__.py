"""Sources of launch descriptions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ..utilities import normalize_to_list_of_substitutions, perform_substitutions
from .python_launch_file_utilities import get_launch_description_from_python_launch_file

if TYPE_CHECKING:
    from ..core import LaunchContext
    from ..launch_description import LaunchDescription
    from ..utilities import Part


class PythonLaunchDescriptionSource:
    def __init__(self, launch_file_path: Part | Iterable[Part]) -> None:
        self._path = launch_file_path

    def get_launch_description(self, context: LaunchContext) -> LaunchDescription:
        path = perform_substitutions(context, normalize_to_list_of_substitutions(self._path))
        return get_launch_description_from_python_launch_file(path)
