"""Installation folder of ROS 1's Python packages.

I/O; the import system. Imports nothing of ROS.
"""

from __future__ import annotations

import importlib.util
import os
from typing import Final

from gdp.errors import LocalError

_DEBIAN: Final = "/usr/lib/python3/dist-packages"


def rospy_folder() -> str:
    """Return the folder to import rospy from: of a sourced ROS 1, or Debian's.

    Raises:
        LocalError: there is none; the text states what to install.
    """
    spec = importlib.util.find_spec("rospy")
    if spec is not None and spec.origin is not None:
        return os.path.dirname(os.path.dirname(spec.origin))
    if os.path.isfile(f"{_DEBIAN}/rospy/__init__.py"):
        return _DEBIAN
    raise LocalError(
        "ROS 1 needs rospy, which is not installed here: run sudo scripts/setup_ros1.sh, or source your ROS 1"
    )
