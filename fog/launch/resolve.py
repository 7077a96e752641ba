"""Which program a node's ``package`` and ``executable`` are.

I/O; looks where ROS packages lie. First what ``ros2 run`` would start, ``lib/<package>/<executable>`` of a
prefix in ``AMENT_PREFIX_PATH``; else the Python module ``<package>.<executable>``.
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

__all__ = ["PYTHON", "command_line", "deferred", "file_of"]

PYTHON: Final = "{python}"  # the machine's own, as fog.machine.Program has it


def command_line(node: CloudNode, environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return what starts a node on a machine that has the same packages as this one.

    Args:
        environment: of the machine, for ``AMENT_PREFIX_PATH``.

    Raises:
        LocalError: there is no such executable and no such module.
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
    """Return what looks for a node on the machine itself, when it starts there."""
    return (PYTHON, "-m", "fog.launch.run", node.package, node.executable, *node.arguments)


def file_of(node: CloudNode, environment: Mapping[str, str]) -> Path | None:
    """Return the file that a node's code begins in; None: it is not found."""
    module = _module(node)
    return _program(node, environment) or (Path(module) if module else None)


def _program(node: CloudNode, environment: Mapping[str, str]) -> Path | None:
    """Return the executable that ``ros2 run`` would start; None: there is none."""
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
