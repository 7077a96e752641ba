"""Every experiment runs: a short round of each, whose figures nobody looks at but those that must be nought."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.pages import ROOT

_PATIENCE_S = 200.0
_NEEDS = {
    "fig5": ("rclpy", "ompl", "fcl", "trimesh", "collada", "scipy", "matplotlib"),
    "fig6": ("rclpy", "scipy", "matplotlib"),
    "fig7": ("rclpy", "scipy", "matplotlib"),
    "fig9": ("rclpy", "pupil_apriltags", "scipy", "matplotlib"),
}

_OPTIONS = {"fig5": ("--waits", "0")}  # a second field for those would take as long again

pytestmark = pytest.mark.netns


@pytest.mark.parametrize("name", list(_NEEDS))
def test_an_experiment_runs_to_its_page_without_a_failed_request(name: str, tmp_path: Path) -> None:
    if missing := [module for module in _NEEDS[name] if find_spec(module) is None]:
        pytest.skip(f"not installed: {', '.join(missing)}: scripts/setup.sh --ros2, pip install 'gdp-ros[experiments]'")
    if name == "fig5" and not (ROOT.parent / "shared" / "data" / "planning").is_dir():
        pytest.skip("no ../shared/data/planning here")
    argv = [sys.executable, str(ROOT / "scripts" / "experiments" / f"{name}.py"), "--quick", "--json"]
    ran = subprocess.run(
        [*argv, *_OPTIONS.get(name, ()), "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert all(is_right for group in told["groups"].values() for *_, is_right in group), told["groups"]
    assert {each.name for each in tmp_path.iterdir()} == {f"{name}.{kind}" for kind in ("json", "md", "png")}
    if name == "fig9":
        found = {each["what"]: each["got"] for each in told["findings"]}
        assert found["kills"] >= 1
        assert found["failed requests"] == found["answers too many"] == 0
