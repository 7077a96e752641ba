"""Bench of replicas: a short round of its parts; the figures are not checked."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec

import pytest

from tests.pages import ROOT

pytestmark = [
    pytest.mark.netns,
    pytest.mark.nightly,
    pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy is not installed: scripts/setup.sh --ros2"),
]

_PATIENCE_S = 200.0


def bench(name: str, *options: str) -> str:
    """Run a bench; return its tables."""
    argv = [sys.executable, str(ROOT / "scripts" / "bench" / name), *options, "--no-save"]
    ran = subprocess.run(argv, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_no_request_fails_while_two_of_three_replicas_are_killed_and_come_back() -> None:
    reported = bench("replicas.py", "--only", "killed", "--rounds", "1", "--requests", "800", "--rate", "200")
    assert reported.count("target ≤ 0.00, measured 0.00, met") == 3, reported


def test_replicas_are_compared_with_a_single_server() -> None:
    reported = bench("replicas.py", "--only", "hedged", "--rounds", "1", "--requests", "60")
    assert "two replicas, the second if late" in reported
