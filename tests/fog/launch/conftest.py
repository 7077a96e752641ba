"""ROS 2's ``launch``, ``launch_ros`` and ``ros2cli``: stand-ins, or the real packages (``ros2/README.md``)."""

from __future__ import annotations

import asyncio
import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

_OURS = (
    "fog.launch.ros_action",
    "fog.launch.ros_node",
    "fog.launch.ros_action",
    "fog.launch.ros_description",
    "fog.ros2cli.command",
    "fog.ros2cli.option",
    "fog.ros2cli.verb",
)
_THEIRS = ("launch", "launch_ros", "ros2cli", "ros2launch", "ros2pkg", "osrf_pycommon")
_REAL = "FOG_TEST_ROS2"


@pytest.fixture(params=["stand-ins", "real"])
def ros2(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Put ROS 2's packages on the path, and remove them afterwards."""
    folder = str(Path(__file__).parent / "ros2")
    if request.param == "real":
        folder = os.environ.get(_REAL, "")
        if not folder:
            pytest.skip(f"{_REAL} names no folder: ROS 2's launch is on no package index (tests/fog/launch/ros2)")
        monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros-log"))
    monkeypatch.syspath_prepend(folder)
    if request.param == "real":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # imported by these packages
            importlib.import_module("launch_ros.actions")
        _forget()
    yield
    if "osrf_pycommon" in sys.modules:
        with suppress(RuntimeError):  # no launch was run
            asyncio.get_event_loop_policy().get_event_loop().close()
        asyncio.set_event_loop(None)
    _forget()


def _forget() -> None:
    for name in list(sys.modules):
        if name in _OURS or name.partition(".")[0] in _THEIRS:
            del sys.modules[name]
