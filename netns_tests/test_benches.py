"""Every bench in a short round; the figures are not checked."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from shutil import which

import pytest

pytestmark = [pytest.mark.netns, pytest.mark.nightly]

_PATIENCE_S = 300.0
needs_ros2 = pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy is not installed: scripts/setup.sh --ros2")
needs_wireguard = pytest.mark.skipif(
    which("wireguard-go") is None or which("wg") is None, reason="wireguard-go or wireguard-tools is not installed"
)


@pytest.mark.parametrize(
    "command",
    [
        ["forwarding.py", "--quick", "--no-save"],
        ["messages.py", "--quick", "--mtu", "9000", "--load", "none"],
        pytest.param(["first_topic.py", "--rounds", "1", "--no-save"], marks=[needs_ros2, needs_wireguard]),
        ["uplink.py", "--quick", "--no-save", "--no-tcp", "--fifo", "bdp", "--only", "gdp"],
        ["own_pace.py", "--quick", "--no-save"],
        pytest.param(["ros.py", "--quick", "--no-save", "--mtu", "9000"], marks=needs_ros2),
        pytest.param(["ros.py", "--calls", "--quick", "--no-save"], marks=needs_ros2),
        pytest.param(["tunnel.py", "--quick", "--no-save"], marks=needs_wireguard),
        ["survive.py", "--only", "cut", "--rounds", "1", "--no-save"],
    ],
    ids=lambda command: command[0],
)
def test_a_bench_runs_to_its_table_from_a_clone_alone(
    command: list[str], in_clone: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    name, *options = command
    if not {"--quick", "--no-save", "--help"}.intersection(options):
        options.append("--no-save")  # else a busy machine is refused
    ran = in_clone(f"scripts/bench/{name}", *options, patience_s=_PATIENCE_S)
    assert ran.returncode == 0, ran.stderr
    assert "not here" not in ran.stdout, ran.stdout
    assert "FAILED" not in ran.stderr, ran.stderr
