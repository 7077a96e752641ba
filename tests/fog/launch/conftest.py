"""ROS 2's ``launch``, ``launch_ros`` and ``ros2cli`` as if installed: stand-ins, see ``ros2/README.md``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

_OURS = ("fog.launch.ros_action", "fog.launch.real_node", "fog.ros2cli.command", "fog.ros2cli.verb")


@pytest.fixture
def ros2(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have ROS 2's packages on the path, and nothing of them afterwards."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "ros2"))
    yield
    for name in list(sys.modules):
        if name in _OURS or name.partition(".")[0] in ("launch", "launch_ros", "ros2cli"):
            del sys.modules[name]
