"""Resolution of a node's ``package`` and ``executable`` to a program.

I/O; searches the folders of ROS packages. The first choice is the program of ``ros2 run``,
``lib/<package>/<executable>`` of a prefix in ``AMENT_PREFIX_PATH``; the second is the Python module
``<package>.<executable>``.
Source: https://docs.ros.org/en/jazzy/Concepts/Advanced/About-Build-System.html (the prefix's layout).
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from fog.cluster import CloudNode
from gdp.errors import LocalError

PYTHON: Final = "{python}"  # the machine's Python, see fog.machine.Program


def command_line(node: CloudNode, environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the command line of a node for a machine that has the same packages as this one.

    Args:
        environment: of the machine, for ``AMENT_PREFIX_PATH``.
    """
    path = _program(node, environment)
    if path is not None:
        return (str(path), *node.arguments)
    if _module(node) is None:
        raise LocalError(
            f"{node.package}/{node.executable}: not found: neither lib/{node.package}/{node.executable} in"
            f" AMENT_PREFIX_PATH nor the Python module {node.package}.{node.executable}"
        )
    return (PYTHON, "-m", f"{node.package}.{node.executable}", *node.arguments)


def deferred(node: CloudNode) -> tuple[str, ...]:
    """Return the command line that resolves a node on the machine itself, at its start."""
    return (PYTHON, "-m", "fog.launch.run", node.package, node.executable, *node.arguments)


def file_of(node: CloudNode, environment: Mapping[str, str]) -> Path | None:
    """Return the file of a node's executable or module; None: it is not found."""
    module = _module(node)
    return _program(node, environment) or (Path(module) if module else None)


def _program(node: CloudNode, environment: Mapping[str, str]) -> Path | None:
    """Return the executable for ``ros2 run``; None: there is none."""
    for prefix in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "lib" / node.package / node.executable
        if prefix and path.is_file() and os.access(path, os.X_OK):
            return path
    return None


def _module(node: CloudNode) -> str | None:
    try:
        spec = importlib.util.find_spec(f"{node.package}.{node.executable}")
    except (ImportError, ValueError):
        return None
    return spec.origin if spec else None
