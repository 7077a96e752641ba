"""Every experiment in its shortest round, from a clone alone; only figures that must be zero are checked."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

_PATIENCE_S = 400.0
_NEEDS = {
    "availability": ("matplotlib",),
    "table1": ("matplotlib",),
    "fig4": ("rclpy", "cv2", "scipy", "matplotlib"),
    "fig5": ("rclpy", "ompl", "fcl", "trimesh", "collada", "scipy", "matplotlib"),
    "fig6": ("rclpy", "scipy", "matplotlib"),
    "fig7": ("rclpy", "scipy", "matplotlib"),
    "fig6 --compute": ("rclpy", "scipy", "matplotlib", "rapidocr_onnxruntime"),
    "fig9": ("rclpy", "cv2", "scipy", "matplotlib"),
    "outages": ("rclpy", "matplotlib"),
    "offload": ("rclpy", "cyclonedds", "cv2", "scipy", "matplotlib"),
}

_OPTIONS = {"fig5": ("--waits", "0")}  # a second testbed for these would take as long again
InClone = Callable[..., "subprocess.CompletedProcess[str]"]

pytestmark = pytest.mark.netns


@pytest.fixture
def run(in_clone: InClone, tmp_path: Path) -> Callable[[str], dict[str, Any]]:
    """Return a function that runs a short round of an experiment and returns its JSON."""

    def run_one(name: str) -> dict[str, Any]:
        if missing := [module for module in _NEEDS[name] if find_spec(module) is None]:
            needed = "scripts/setup.sh --ros2, pip install 'gdp-ros[experiments]'"
            pytest.skip(f"not installed: {', '.join(missing)}: {needed}")
        name, *own = name.split()
        words = ["--quick", "--json", "--out", str(tmp_path), *own, *_OPTIONS.get(name, ())]
        ran = in_clone(f"scripts/experiments/{name}.py", *words, patience_s=_PATIENCE_S)
        assert ran.returncode == 0, ran.stderr
        assert {each.name for each in tmp_path.iterdir()} == {f"{name}.{kind}" for kind in ("json", "md", "png")}
        reported = json.loads(ran.stdout)
        assert reported["machine"]["commit"]
        assert isinstance(reported, dict)
        return reported

    return run_one


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["fig4", "fig5", "fig6", "fig6 --compute", "fig7", "fig9"])
def test_an_experiment_runs_to_its_page_without_a_failed_request(
    name: str, run: Callable[[str], dict[str, Any]]
) -> None:
    reported = run(name)
    assert all(is_right for group in reported["groups"].values() for *_, is_right in group), reported["groups"]
    if name == "fig9":
        found = {each["what"]: each["measured"] for each in reported["findings"]}
        assert found["kills"] >= 1
        assert found["failed requests"] == found["answers too many"] == 0


@pytest.mark.nightly
def test_machines_stop_and_go_on_and_every_request_is_counted(run: Callable[[str], dict[str, Any]]) -> None:
    groups = run("outages")["groups"]
    assert {name: len(group) for name, group in groups.items()} == {"one machine": 60, "two machines": 60}


@pytest.mark.parametrize("name", [pytest.param("availability", marks=pytest.mark.nightly), "table1"])
def test_an_experiment_that_computes_runs_to_its_page(name: str, run: Callable[[str], dict[str, Any]]) -> None:
    assert run(name)["experiment"] == name


@pytest.mark.nightly
def test_a_task_is_computed_on_the_robot_and_beyond_three_domains_in_either_encoding_and_every_answer_is_right(
    run: Callable[[str], dict[str, Any]],
) -> None:
    (task,) = run("offload")["tasks"].values()
    assert task["alone"]["failed"] == 0
    contenders = task["network"]["contenders"]
    assert {"overlay, JSON", "overlay, CDR"} <= contenders.keys()
    for contender in contenders.values():
        assert contender["failed"] == 0
        assert len(contender["there_s"]) == 3
        assert len(contender["total_s"]) == 2
