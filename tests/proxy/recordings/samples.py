"""Paths of the shared recordings, for the tests that need them."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "bags"
READABLE = (
    "tilt_laser.bag",
    "rosbag2_test",
    "ros_numpy_test.bag",
    "event_camera.bag",
    "ninety_four_types.mcap",
    "turtlesim.bag",
    "aruco_compressed.bag",
)
UNREADABLE = "broken_for_rosbags_service_events.mcap"


def recording(name: str) -> Path:
    """Return the path of a shared recording, or skip the test."""
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"the shared recording {name} is not there (expected in ../shared/data/bags)")
    return path
