"""Environment variables that child processes inherit: ROS nodes, probes, and the programs of a machine.

Sans-I/O. A node needs the location of ROS and its communication settings. It does not need the operator's cloud
credentials or agents (``AWS_SECRET_ACCESS_KEY``, ``SSH_AUTH_SOCK``), so only the names listed here are passed on.
``FOG_PASS_ENVIRONMENT`` lists further names, separated by blanks or commas; ``PREFIX_*`` means all names with that
prefix.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

PASS_MORE: Final = "FOG_PASS_ENVIRONMENT"
_NAMES: Final = (
    *("PATH", "HOME", "USER", "LOGNAME", "SHELL", "LANG", "LANGUAGE", "LC_*", "TZ", "TERM", "COLORTERM", "NO_COLOR"),
    *("TMPDIR", "XDG_RUNTIME_DIR", "PYTHON*", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "CMAKE_PREFIX_PATH"),
    *("ROS_*", "RMW_*", "RCL_*", "RCUTILS_*", "AMENT_*", "COLCON_*", "ROSCONSOLE_*", "FOG_*"),
    *("CYCLONEDDS_*", "FASTDDS_*", "FASTRTPS_*", "ZENOH_*", "GZ_*", "IGN_*", "GAZEBO_*"),
    *("CUDA_*", "NVIDIA_*", "OMP_*", "OPENBLAS_*", "MKL_*"),
)
_DESKTOP: Final = ("DISPLAY", "WAYLAND_DISPLAY", "XAUTHORITY", "XDG_SESSION_TYPE", "QT_*", "LIBGL_*")


def child_environment(environment: Mapping[str, str], *, has_desktop: bool = False) -> dict[str, str]:
    """Return the part of an environment that a child process inherits.

    Args:
        has_desktop: also the variables that a window needs, for nodes on the robot's side such as RViz.
    """
    more = re.split(r"[\s,]+", environment.get(PASS_MORE, ""))
    wanted = {*_NAMES, *(_DESKTOP if has_desktop else ()), *(name for name in more if name.strip("*"))}
    starts = tuple(name[:-1] for name in wanted if name.endswith("*"))
    return {key: value for key, value in environment.items() if key in wanted or key.startswith(starts)}
