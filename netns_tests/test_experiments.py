"""Every experiment in a short round; only the figures that must be zero are checked."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.pages import ROOT

_PATIENCE_S = 200.0
_NEEDS = {
    "fig5": ("rclpy", "ompl", "fcl", "trimesh", "collada", "scipy", "matplotlib"),
    "fig6": ("rclpy", "scipy", "matplotlib"),
    "fig7": ("rclpy", "scipy", "matplotlib"),
    "fig9": ("rclpy", "pupil_apriltags", "scipy", "matplotlib"),
    "outages": ("rclpy", "matplotlib"),
    "offload": ("rclpy", "cyclonedds", "cv2", "scipy", "matplotlib"),
}

_OPTIONS = {"fig5": ("--waits", "0")}  # a second testbed for these would take as long again

pytestmark = pytest.mark.netns


def run(name: str, out: Path) -> dict[str, Any]:
    """Run a short round of an experiment; return its JSON."""
    if missing := [module for module in _NEEDS[name] if find_spec(module) is None]:
        pytest.skip(f"not installed: {', '.join(missing)}: scripts/setup.sh --ros2, pip install 'gdp-ros[experiments]'")
    argv = [sys.executable, str(ROOT / "scripts" / "experiments" / f"{name}.py"), "--quick", "--json"]
    ran = subprocess.run(
        [*argv, *_OPTIONS.get(name, ()), "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert {each.name for each in out.iterdir()} == {f"{name}.{kind}" for kind in ("json", "md", "png")}
    reported = json.loads(ran.stdout)
    assert isinstance(reported, dict)
    return reported


@pytest.mark.parametrize(
    "name", ["fig5", *(pytest.param(each, marks=pytest.mark.soak) for each in ("fig6", "fig7", "fig9"))]
)
def test_an_experiment_runs_to_its_page_without_a_failed_request(name: str, tmp_path: Path) -> None:
    if name == "fig5" and not (ROOT.parent / "shared" / "data" / "planning").is_dir():
        pytest.skip("no ../shared/data/planning here")
    reported = run(name, tmp_path)
    assert all(is_right for group in reported["groups"].values() for *_, is_right in group), reported["groups"]
    if name == "fig9":
        found = {each["what"]: each["measured"] for each in reported["findings"]}
        assert found["kills"] >= 1
        assert found["failed requests"] == found["answers too many"] == 0


def test_machines_stop_and_go_on_and_every_request_is_counted(tmp_path: Path) -> None:
    reported = run("outages", tmp_path)
    assert {name: len(group) for name, group in reported["groups"].items()} == {"one machine": 60, "two machines": 60}


@pytest.mark.skipif(not (ROOT.parent / "shared" / "data" / "rgbd").is_dir(), reason="no ../shared/data/rgbd here")
def test_a_task_is_computed_on_the_robot_and_beyond_three_switches_and_every_answer_is_right(tmp_path: Path) -> None:
    (task,) = run("offload", tmp_path)["tasks"].values()
    assert task["alone"]["failed"] == 0
    for contender in task["network"]["contenders"].values():
        assert contender["failed"] == 0
        assert len(contender["there_s"]) == 3
        assert len(contender["total_s"]) == 2
